"""When the launcher ends a run, and the reason it reports."""

import signal
import subprocess
import sys
from pathlib import Path
from typing import Any, cast

import pytest

from cosim.live.launcher import _Run
from cosim.live.monitoring.run_observers import RunObserver, RunObservers
from cosim.live.processes.child_processes import ChildProcesses, EndReason
from cosim.live.processes.early_certificates import EarlyCertificates
from netem.core.command_line import Signals
from netem.core.errors import ExitStatus
from noack.protocol.roles import RECORDER, ROLES
from noack.scenario.resolution import resolve_run
from noack.scenario.scenario_file import validate
from tests.helpers.waiting import wait_for

LOG = "noack sensor: no room\n"


class Child:
    """A process that has exited with a status, or is running."""

    pid = 0

    def __init__(self, exitcode: int | None = None) -> None:
        self.exitcode = exitcode


class FakeCoordinator:
    """The part of the coordinator that the launcher uses."""

    epoch_ns = 0

    def __init__(self, now_s: float, exiting: str = "", **failures: str) -> None:
        self._now_s, self._exiting, self._failures = now_s, exiting, failures
        self._running: tuple[str, ...] = ROLES
        self.notices: list[str] = []

    def now_ns(self) -> int:
        return round(self._now_s * 1e9)

    def failures(self) -> dict[str, str]:
        return self._failures

    def instances(self) -> dict[str, str]:
        return {}

    def is_over(self, role: str) -> bool:
        return role not in self._running

    def has_ended(self, role: str) -> bool:
        return role not in (*self._running, *self._failures)

    def is_exiting(self, role: str) -> bool:
        return role == self._exiting

    def await_reported_failure(self, role: str) -> str | None:
        return "the disk is full"


class FakeChildren(ChildProcesses):
    """All processes run except the sensor, which has exited."""

    def __init__(self, run_dir: Path, code: int | None) -> None:
        super().__init__(run_dir, ROLES, fork=False)
        self._children = cast(Any, {role: Child() for role in ROLES} | {"sensor": Child(code)})

    def exit(self, role: str, code: int) -> None:
        cast(Any, self._children[role]).exitcode = code


class Calls(RunObserver):
    """Calls functions, given by the names of methods."""

    def __init__(self, **functions: Any) -> None:
        vars(self).update(functions)


class Case:
    """A run of one second."""

    def __init__(self, content: dict[str, Any], run_dir: Path) -> None:
        self.resolved = resolve_run(validate(content, ""))
        self.run_dir = run_dir
        (run_dir / "logs").mkdir()
        self.log = run_dir / "logs" / "sensor.log"
        self.log.write_text(LOG)

    def children(self, code: int | None) -> FakeChildren:
        return FakeChildren(self.run_dir, code)

    def run(self, children: FakeChildren, coordinator: FakeCoordinator, **watch: Any) -> _Run:
        observers, certificates = RunObservers([Calls(**watch)]), EarlyCertificates()
        return _Run(self.resolved, 7, self.run_dir, cast(Any, coordinator), children, observers, certificates)


@pytest.fixture
def case(content: dict[str, Any], tmp_path: Path) -> Case:
    return Case(content, tmp_path)


@pytest.mark.parametrize(
    ("code", "now_s", "log", "expected"),
    [
        (None, 0.5, LOG, None),
        (-9, 0.5, LOG, (ExitStatus.FAILED, "sensor died: killed by SIGKILL")),
        (1, 0.5, LOG, (ExitStatus.FAILED, "sensor: no room")),
        (2, 0.5, f"{LOG}ERROR of a library\n", (ExitStatus.CALLER, "sensor: no room")),
        (1, 0.5, "ERROR of a library\n", (ExitStatus.FAILED, "sensor: the disk is full")),
        (1, 0.5, None, (ExitStatus.FAILED, "sensor: the disk is full")),
    ],
)
def test_a_process_that_fails_ends_the_run_with_its_reason(
    case: Case, code: int | None, now_s: float, log: str | None, expected: EndReason | None
) -> None:
    """The reason is taken from the log, or else from the report."""
    case.log.unlink()
    if log is not None:
        case.log.write_text(log)
    coordinator = FakeCoordinator(now_s)
    assert case.run(case.children(code), coordinator)._failure() == expected


@pytest.mark.parametrize(("code", "fails"), [(None, True), (0, False), (-9, True)])
def test_a_launched_process_that_has_exited_well_is_not_lost(
    case: Case, code: int | None, fails: bool
) -> None:
    """Its connection was lost, as the launcher was stopped."""
    coordinator = FakeCoordinator(2.0, sensor="stopped responding")
    assert (case.run(case.children(code), coordinator)._failure() is not None) is fails


@pytest.mark.parametrize(
    ("running", "lost", "late"),
    [
        (("plant", RECORDER), (), "there is no report from plant"),
        ((), (RECORDER,), "there is no report from recorder"),  # it sorts a long record
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
        f"the run did not end at its horizon: {late}; likely cause: too slow, stopped, or hung in code of "
        "yours; reduce the speed or the rates"
    )


@pytest.mark.skipif(sys.platform != "linux", reason="the state of a process is in /proc")
@pytest.mark.parametrize("now_s", [0.5, 2.0], ids=["within the run", "after the horizon"])
def test_a_stopped_process_is_named_with_its_state(
    case: Case, now_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The load is not blamed; a process that goes on is no failure."""
    said = "is stopped (state T), by a signal such as SIGSTOP or by a debugger"
    with subprocess.Popen([sys.executable, "-c", "import time; time.sleep(1000)"]) as process:
        children = case.children(None)
        cast(Any, children._children[RECORDER]).pid = process.pid
        run = case.run(children, FakeCoordinator(now_s))
        monkeypatch.setattr(FakeCoordinator, "poll", lambda self: None, raising=False)
        monkeypatch.setattr(run, "_follow_phase", lambda: None)
        process.send_signal(signal.SIGSTOP)
        wait_for(lambda: children.stopped() == {RECORDER})
        run._advance(waits=True)
        assert run._failure() is None  # not yet
        assert run._overdue() == f"recorder {said}"
        run._stopped_since_s["plant"] = run._last_s
        assert run._overdue() == f"recorder, plant {said}".replace(" is ", " are ")
        del run._stopped_since_s["plant"]
        monkeypatch.setattr("cosim.live.launcher._STOPPED_S", -1.0)
        assert run._failure() == (ExitStatus.FAILED, f"recorder {said}")
        process.send_signal(signal.SIGCONT)
        wait_for(lambda: children.stopped() == set())
        run._next_look_s = 0.0
        run._advance(waits=True)
        assert run._failure() is None
        process.kill()


class Ending(FakeCoordinator):
    """The plant dies at the first check; a last report arrives after it."""

    children: FakeChildren
    reports = 0

    def poll(self) -> None:
        self.children.exit("plant", -9)

    def progress(self) -> Any:
        self.reports += 1
        return {"warnings": ["late"]} if self.reports == 2 else None

    def stop(self, reason: str) -> None: ...


def test_why_a_run_ends_early_is_shown_before_its_processes_end(case: Case) -> None:
    """The completion of the record of many loops takes minutes."""
    calls: list[Any] = []

    def stopping(reason: str) -> None:
        assert children.running()
        calls.append(reason)
        for role in ROLES:
            children.exit(role, 0)

    children, coordinator = case.children(None), Ending(0.5)
    coordinator.children = children
    run = case.run(children, coordinator, stopping=stopping, progress=calls.append)
    status, reason = run.watch(Signals(), lambda *_: None)
    assert calls == [reason, {"warnings": ["late"]}]
    assert (status, reason) == (ExitStatus.FAILED, "plant died: killed by SIGKILL")
