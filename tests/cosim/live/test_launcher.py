"""Which processes the launcher restarts, when it ends the run, and the reason it reports."""

import time
from pathlib import Path
from queue import SimpleQueue
from typing import Any, cast

import pytest

from cosim.live.child_processes import ChildProcesses, Failure
from cosim.live.launcher import _Run, launch, overtime_s
from cosim.live.run_watcher import Watcher
from noack.core.errors import CallerError, ExitStatus, MachineError
from noack.protocol.topology import RECORDER, ROLES
from noack.runtime.command_line import Signals
from noack.runtime.join_ticket import new_ticket, published
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import validate

KILLED = "sensor died: killed by SIGKILL"


class Child:
    """A process that has exited with a status, or is running."""

    stdin = None

    def __init__(self, code: int | None = None) -> None:
        self.code = code

    def poll(self) -> int | None:
        return self.code

    wait = poll


class FakeCoordinator:
    """The part of the coordinator that the launcher uses."""

    epoch_ns = 0

    def __init__(self, now_s: float, exiting: str = "", **failures: str) -> None:
        self._now_s, self._exiting, self._failures = now_s, exiting, failures
        self._running: tuple[str, ...] = ROLES
        self.restarts: list[str] = []
        self.joined: dict[str, Any] = {}

    def now_ns(self) -> int:
        return round(self._now_s * 1e9)

    def failures(self) -> dict[str, str]:
        return self._failures

    def running_generation(self, role: str) -> None:
        return None

    def is_over(self, role: str) -> bool:
        return role not in self._running

    def has_ended(self, role: str) -> bool:
        return role not in (*self._running, *self._failures)

    def is_exiting(self, role: str) -> bool:
        return role == self._exiting

    def reported_failure(self, role: str) -> str | None:
        return "the disk is full"

    def allow_restart(self, role: str, failure: str, *, dead: bool) -> None:
        self.restarts.append(role)


class FakeChildren(ChildProcesses):
    """All processes run except the sensor, which has exited."""

    def __init__(self, ticket: Any, run_dir: Path, code: int | None) -> None:
        super().__init__(ticket, run_dir, ROLES)
        self._children = cast(Any, {role: Child() for role in ROLES} | {"sensor": Child(code)})
        self.can_start = True

    def _start(self, role: str, *, live: bool) -> Any:
        if not self.can_start:
            raise MachineError(f"{role} cannot be started: no more processes")
        return Child()

    def exit(self, role: str, code: int) -> None:
        cast(Any, self._children[role]).code = code


class Case:
    """A run of one second whose scenario allows restarts."""

    def __init__(self, content: dict[str, Any], run_dir: Path) -> None:
        resolved = resolve(validate(content | {"recovery": {"rejoin_within_s": 60}}, ""))
        self.ticket = new_ticket(resolved, run_dir, launched=True)
        self.run_dir = run_dir
        (run_dir / "logs").mkdir()
        self.log = run_dir / "logs" / "sensor.log"
        self.log.write_text("noack sensor: no room\n")

    def children(self, code: int | None) -> FakeChildren:
        return FakeChildren(self.ticket, self.run_dir, code)

    def run(self, children: FakeChildren, coordinator: FakeCoordinator, **watch: Any) -> _Run:
        watcher = Watcher(**watch)
        return _Run(
            self.ticket, self.run_dir, cast(Any, coordinator), children, watcher, SimpleQueue()
        )

    def result(self, code: int | None, now_s: float = 0.5, **failures: str) -> Failure | None:
        coordinator = FakeCoordinator(now_s, **failures)
        found = self.run(self.children(code), coordinator)._policy.check()
        assert found is not None or coordinator.restarts == ["sensor"] * bool(code)
        return found


@pytest.fixture
def case(content: dict[str, Any], tmp_path: Path) -> Case:
    return Case(content, tmp_path)


@pytest.mark.parametrize("code", [-9, 143])
def test_a_killed_process_is_restarted(case: Case, code: int) -> None:
    assert case.result(code) is None


@pytest.mark.parametrize("code", [1, 2])
def test_a_process_that_reported_an_error_is_not_restarted(case: Case, code: int) -> None:
    assert case.result(code) == (code, "sensor: no room")


@pytest.mark.parametrize(
    ("log", "why"),
    [
        ("noack sensor: no room\nERROR of a library\n", "no room"),
        ("ERROR of a library\n", "the disk is full"),
        (None, "the disk is full"),
    ],
)
def test_the_reason_is_taken_from_the_log_or_else_from_the_report(
    case: Case, log: str | None, why: str
) -> None:
    case.log.unlink()
    if log is not None:
        case.log.write_text(log)
    assert case.result(1) == (ExitStatus.FAILED, f"sensor: {why}")


def test_the_exit_status_of_a_process_takes_precedence_over_its_report(case: Case) -> None:
    children = case.children(None)
    coordinator = FakeCoordinator(0.5, "sensor", sensor="sensor ended early: no room")
    policy = case.run(children, coordinator)._policy
    assert policy.check() is None
    children.exit("sensor", 2)
    assert policy.check() == (ExitStatus.CALLER, "sensor: no room")


def test_after_the_horizon_nothing_is_restarted_and_the_plant_never_is(case: Case) -> None:
    assert case.result(-9, now_s=1.0) == (ExitStatus.FAILED, KILLED)
    children = case.children(None)
    children.exit("plant", -9)
    reason = "plant died: killed by SIGKILL"
    assert case.run(children, FakeCoordinator(0.5))._policy.check() == (ExitStatus.FAILED, reason)


def test_a_restart_that_fails_ends_the_run(case: Case) -> None:
    children = case.children(-9)
    children.can_start = False
    reason = f"{KILLED}; sensor cannot be started: no more processes"
    assert case.run(children, FakeCoordinator(0.5))._policy.check() == (ExitStatus.FAILED, reason)


def test_a_process_that_is_not_restarted_ends_the_run(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = case.run(case.children(-9), FakeCoordinator(0.5))._policy
    assert policy.check() is None
    now_s = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now_s + 61.0)
    assert policy.check() == (ExitStatus.FAILED, f"{KILLED}; not restarted within 60 s")


def test_a_restarted_process_that_fails_ends_the_run_with_both_reasons(case: Case) -> None:
    children = case.children(-9)
    policy = case.run(children, FakeCoordinator(0.5))._policy
    assert policy.check() is None
    assert policy.unfinished() == (ExitStatus.FAILED, f"{KILLED}; not restarted before the end")
    children.exit("sensor", 2)
    assert policy.check() == (ExitStatus.CALLER, f"{KILLED}; restarted, sensor: no room")


@pytest.mark.parametrize(
    ("running", "lost", "late"),
    [
        (("plant", RECORDER), (), "no report from plant"),
        ((RECORDER,), (), "no report from recorder"),
        ((), (RECORDER,), "no report from recorder"),  # it sorts a long record
        ((), (), f"{', '.join(ROLES)} reported the end, but did not exit"),
    ],
)
def test_a_run_that_does_not_end_names_the_late_process(
    case: Case, running: tuple[str, ...], lost: tuple[str, ...], late: str
) -> None:
    coordinator = FakeCoordinator(2.0, **dict.fromkeys(lost, "stopped responding"))
    coordinator._running = running
    reason = case.run(case.children(None), coordinator)._overdue()
    assert reason == (
        f"the run did not end at its horizon: {late}, too slow or stopped; reduce the speed or the "
        "rates"
    )


@pytest.mark.parametrize(("load", "counts"), [(0.0, 1), (8.0, 4)])
def test_the_wait_for_the_end_grows_with_the_load(
    case: Case, monkeypatch: pytest.MonkeyPatch, load: float, counts: int
) -> None:
    """All processes go on after the horizon; time passes by a second at each look."""
    elapsed_s = [0.0]

    def sleep(_: float) -> None:
        elapsed_s[0] += 1.0

    class GoingOn(FakeCoordinator):
        def poll(self) -> None: ...

        def progress(self) -> None: ...

        def stop(self, reason: str) -> None: ...

    monkeypatch.setattr("cosim.live.launcher.time.monotonic", lambda: elapsed_s[0])
    monkeypatch.setattr("cosim.live.launcher.time.sleep", sleep)
    monkeypatch.setattr("os.getloadavg", lambda: (load, 0.0, 0.0))
    monkeypatch.setattr("os.sched_getaffinity", lambda pid: {0, 1})
    stopped_s: list[float] = []
    run = case.run(case.children(None), GoingOn(1.0))
    status, reason = run.watch(Signals(), lambda *_: stopped_s.append(elapsed_s[0]))
    assert status is ExitStatus.FAILED
    assert stopped_s == pytest.approx([counts * overtime_s(1.0)], abs=2 * counts)
    assert ("start fewer runs at once" in reason) == (counts > 1)
    assert elapsed_s[0] - stopped_s[0] > 10.0 * counts  # and for the processes to stop


def test_a_recorder_that_sorts_a_long_record_need_not_respond(case: Case) -> None:
    children = case.children(None)
    coordinator = FakeCoordinator(1.0, recorder="recorder stopped responding")
    policy = case.run(children, coordinator)._policy
    assert policy.check() is None
    children.exit("recorder", -9)
    assert policy.check() == (ExitStatus.FAILED, "recorder died: killed by SIGKILL")


def test_a_progress_report_that_arrives_at_the_end_is_shown(case: Case) -> None:
    class Ending(FakeCoordinator):
        """All processes exit after the first check; the last report arrives after it."""

        looks = 0

        def poll(self) -> None:
            for role in ROLES:
                children.exit(role, 0)

        def progress(self) -> Any:
            self.looks += 1
            return {"warnings": ["late"]} if self.looks == 2 else None

    shown: list[Any] = []
    children = case.children(None)
    run = case.run(children, Ending(1.0), progress=shown.append)
    assert run.watch(Signals(), lambda status, reason: None)[0] is ExitStatus.OK
    assert shown == [{"warnings": ["late"]}]


def test_why_a_run_ends_early_is_shown_before_its_processes_end(case: Case) -> None:
    """The completion of the record of many loops takes minutes."""
    children = case.children(None)
    shown: list[str] = []

    class Ending(FakeCoordinator):
        def poll(self) -> None:
            children.exit("plant", -9)  # never restarted

        def progress(self) -> None: ...

        def stop(self, reason: str) -> None: ...

    def stopping(why: str) -> None:
        assert children.running()
        shown.append(why)
        for role in ROLES:
            children.exit(role, 0)

    status, reason = case.run(children, Ending(0.5), stopping=stopping).watch(
        Signals(), lambda *_: None
    )
    assert shown == [reason] == ["plant died: killed by SIGKILL"]
    assert status is ExitStatus.FAILED


def test_a_refused_session_leaves_no_run_directory(
    content: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    scenario = validate(content | {"ports": {}}, "")
    ticket = new_ticket(resolve(scenario), tmp_path, launched=False)
    with published(ticket, "lab"), pytest.raises(CallerError, match="another run is open in it"):
        launch(scenario, tmp_path / "runs", spawn=(), session="lab")
    assert list((tmp_path / "runs").iterdir()) == []
