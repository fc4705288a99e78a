"""Whom the launcher starts anew, and when it ends the run instead."""

from pathlib import Path
from typing import Any, cast

import pytest

from cosim.live.launcher import Watcher, _Run, longest_s
from noack.config.resolution import resolve
from noack.config.scenario_file import validate
from noack.core.errors import ExitStatus, MachineError
from noack.protocol.topology import ROLES
from noack.runtime.join_ticket import new_ticket
from noack.runtime.signals import Signals


class Child:
    """A process that has ended, or has not."""

    stdin = None

    def __init__(self, code: int | None = None) -> None:
        self.code = code

    def poll(self) -> int | None:
        return self.code

    wait = poll


class Barrier:
    """What the launcher asks the coordinator."""

    epoch_ns = 0

    def __init__(self, now_s: float) -> None:
        self._now_s = now_s
        self.expected: list[str] = []

    def now_ns(self) -> int:
        return round(self._now_s * 1e9)

    def gone(self) -> dict[str, str]:
        return {}

    def generation(self, role: str) -> None:
        return None

    def is_leaving(self, role: str) -> bool:
        return False

    def last_words(self, role: str) -> str | None:
        return "the disk is full"

    def expect(self, role: str, after: str, *, dead: bool) -> None:
        self.expected.append(role)


class Run(_Run):
    """A run of a second in which the sensor has ended; starts processes in name only."""

    def __init__(self, content: dict[str, Any], run_dir: Path, code: int) -> None:
        resolved = resolve(validate(content | {"recovery": {"rejoin_within_s": 60}}, ""))
        ticket = new_ticket(resolved, "tcp/127.0.0.1:1", run_dir, launched=True)
        super().__init__(ticket, run_dir, ROLES, Watcher())
        self._children = cast(Any, {role: Child() for role in ROLES} | {"sensor": Child(code)})
        (run_dir / "logs").mkdir()
        (run_dir / "logs" / "sensor.log").write_text("noack sensor: no room\n")
        self.fails = False

    def _start(self, role: str, *, live: bool) -> Any:
        if self.fails:
            raise MachineError(f"{role} cannot be started: no more processes")
        return Child()

    def verdict(self, now_s: float = 0.5) -> tuple[ExitStatus, str] | None:
        barrier = Barrier(now_s)
        found = self._trouble(cast(Any, barrier))
        assert barrier.expected == ["sensor"] or found is not None
        return found


@pytest.mark.parametrize("code", [-9, -11, 130, 143])
def test_whom_something_ended_is_started_anew(
    content: dict[str, Any], tmp_path: Path, code: int
) -> None:
    assert Run(content, tmp_path, code).verdict() is None


@pytest.mark.parametrize("code", [1, 2])
def test_who_says_why_it_cannot_go_on_is_not(
    content: dict[str, Any], tmp_path: Path, code: int
) -> None:
    """Another would fail as it did, and be started anew until the end of the run."""
    assert Run(content, tmp_path, code).verdict() == (code, "sensor: no room")


@pytest.mark.parametrize(
    ("log", "why"),
    [
        ("noack sensor: no room\nERROR of a library\n", "no room"),
        ("ERROR of a library\n", "the disk is full"),
        ("", "the disk is full"),
        (None, "the disk is full"),
    ],
)
def test_why_a_process_ended_is_what_it_said_itself(
    content: dict[str, Any], tmp_path: Path, log: str | None, why: str
) -> None:
    """On a full disk it cannot log it."""
    run = Run(content, tmp_path, 1)
    path = tmp_path / "logs" / "sensor.log"
    path.unlink()
    if log is not None:
        path.write_text(log)
    assert run.verdict() == (ExitStatus.FAILED, f"sensor: {why}")


def test_a_process_that_says_that_it_ends_is_judged_by_its_exit_status(
    content: dict[str, Any], tmp_path: Path
) -> None:
    class Leaving(Barrier):
        def is_leaving(self, role: str) -> bool:
            return role == "sensor"

        def gone(self) -> dict[str, str]:
            return {"sensor": "sensor ended early: no room"}

    run = Run(content, tmp_path, 0)
    run._children["sensor"] = cast(Any, Child())
    assert run._trouble(cast(Any, Leaving(0.5))) is None
    run._children["sensor"] = cast(Any, Child(2))
    assert run._trouble(cast(Any, Leaving(0.5))) == (ExitStatus.CALLER, "sensor: no room")


def test_after_the_horizon_there_is_nothing_to_take_up(
    content: dict[str, Any], tmp_path: Path
) -> None:
    verdict = Run(content, tmp_path, -9).verdict(now_s=1.0)
    assert verdict == (ExitStatus.FAILED, "sensor died: killed by SIGKILL")


def test_who_cannot_be_started_anew_ends_the_run(content: dict[str, Any], tmp_path: Path) -> None:
    run = Run(content, tmp_path, -9)
    run.fails = True
    reason = "sensor died: killed by SIGKILL; sensor cannot be started: no more processes"
    assert run.verdict() == (ExitStatus.FAILED, reason)


def test_the_recorder_of_a_long_run_has_time_to_put_its_rows_in_order() -> None:
    assert longest_s(20.0) - 20.0 < 30.0
    assert longest_s(3600.0) - 3600.0 > 300.0


def test_a_recorder_that_is_busy_with_a_long_record_s_end_is_not_given_up(
    content: dict[str, Any], tmp_path: Path
) -> None:
    """Putting millions of rows in order, on a busy machine, it may not answer its peers in time."""

    class Silent(Barrier):
        def gone(self) -> dict[str, str]:
            return {"recorder": "recorder stopped answering"}

    run = Run(content, tmp_path, 0)
    assert run._trouble(cast(Any, Silent(1.0))) is None
    run._children["recorder"] = cast(Any, Child(-9))
    reason = "recorder died: killed by SIGKILL"
    assert run._trouble(cast(Any, Silent(1.0))) == (ExitStatus.FAILED, reason)


def test_an_account_that_comes_with_the_end_is_told(
    content: dict[str, Any], tmp_path: Path
) -> None:
    class Ending(Barrier):
        """All end after the first look, and the recorder's last account arrives after it."""

        looks = 0

        def poll(self) -> None:
            for child in run._children.values():
                cast(Any, child).code = 0

        def progress(self) -> dict[str, Any] | None:
            self.looks += 1
            return {"void": ["late"]} if self.looks == 2 else None

    told: list[Any] = []
    run = Run(content, tmp_path, 0)
    run._watcher = Watcher(progress=told.append)
    found = run.watch(cast(Any, Ending(1.0)), Signals(), lambda status, reason: None)
    assert found[0] is ExitStatus.OK
    assert told == [{"void": ["late"]}]
