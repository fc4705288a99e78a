"""The real-time loop: turns of housekeeping around a driver."""

import time
from collections.abc import Sequence
from itertools import count
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from netem.core.clock import RunClock
from noack.protocol.roles import Notice, Record
from noack.runtime.drivers import real_time_loop
from noack.runtime.drivers.real_time_loop import RecordSink, run_loop

PERIOD_NS = 1_000_000
STEPS = 200


class Log:
    """Receives the loop's output."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.rows: list[int] = []

    def append(self, record: Record) -> None:
        self.lines.append(record.table)

    def notice(self, notice: Notice) -> None:
        self.lines.append(notice.text)

    def extend_table(self, table: str, rows: NDArray[Any]) -> None:
        self.rows.append(len(rows))

    def flush(self) -> None:
        self.lines.append("flush")


class Driven:
    """A driver, and the channel that it uses; it notes what is called."""

    def __init__(self, clock: RunClock) -> None:
        self.steps: list[str] = []
        self.until_ns: list[int] = []
        self.clock = clock

    def set_clock(self, clock: RunClock) -> None:
        assert clock is self.clock
        self.steps.append("clock")

    def drive(self, until_ns: int, sink: RecordSink) -> None:
        self.steps.append("drive")
        self.until_ns.append(until_ns - self.clock.now_ns())
        sink.extend_table("table", np.zeros(len(self.until_ns), np.int64))

    def do_housekeeping(self, now_ns: int, sink: RecordSink) -> None:
        self.steps.append("housekeeping")

    def next_deadline_ns(self) -> int | None:
        return -5


@pytest.mark.parametrize("busy", [False, True])
def test_a_turn_of_housekeeping_follows_each_drive(busy: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    pauses, log = list[float](), Log()
    monkeypatch.setattr(time, "sleep", pauses.append)
    cpu_s = count(0, 10**6 if busy else 0)
    monkeypatch.setattr(time, "thread_time", lambda: next(cpu_s))
    driven = Driven(RunClock(time.monotonic_ns(), 3.0))

    def external_inputs(now_ns: int) -> Sequence[Record | Notice]:
        driven.steps.append("external inputs")
        return (Record("row", ()), Notice(now_ns, "info", "line"))

    late_ns = run_loop(
        driven, driven, driven.clock, log, end_ns=None,
        stop=lambda: driven.steps.append("stop") or len(driven.steps) > 9, external_inputs=external_inputs,
    )  # fmt: skip
    turn = ["drive", "housekeeping", "external inputs", "stop"]
    assert driven.steps == ["clock", "external inputs", "housekeeping", *turn, *turn]
    assert log.rows == [1, 2]
    assert log.lines == ["row", "line", *["row", "line", "flush"] * 2]
    assert all(period_ns <= 0.05e9 * 3.0 for period_ns in driven.until_ns)
    assert late_ns > 5
    # A busy driver leaves the core to the other threads for a moment.
    assert len(pauses) == (2 if busy else 0)


class Slow(Driven):
    """Has a deadline every millisecond, and needs a millisecond of its own clock for each step."""

    def __init__(self, wall_ns: int, served: int = 0) -> None:
        super().__init__(RunClock(0, 1.0, lambda: self.wall_ns))
        self.wall_ns, self.served = wall_ns, served

    def drive(self, until_ns: int, sink: RecordSink) -> None:
        while self.served < STEPS and self.clock.now_ns() < until_ns:
            self.wall_ns += PERIOD_NS
            self.served += 1

    def next_deadline_ns(self) -> int | None:
        return self.served * PERIOD_NS if self.served < STEPS else None


def never() -> bool:
    return False


@pytest.mark.parametrize("turns", [20, 0])
def test_a_machine_that_is_late_at_its_end_catches_up_for_a_while(
    turns: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The computer did not run for ten seconds; its steps take two turns or more."""
    monkeypatch.setattr(real_time_loop, "_TURNS_TO_CATCH_UP", turns)
    driven = Slow(10**10)
    late_ns = run_loop(driven, driven, driven.clock, Log(), end_ns=STEPS * PERIOD_NS, stop=never)
    assert (driven.served == STEPS) == (late_ns == 0) == (turns == 20)


@pytest.mark.parametrize("others_turns", [0, 7, 10**9])
def test_a_machine_that_is_done_waits_for_the_others_for_a_while(others_turns: int) -> None:
    given = list[bool]()
    driven = Slow(0, served=STEPS)

    def all_done(done: bool) -> bool:
        given.append(done)
        return done and given.count(True) > others_turns

    run_loop(driven, driven, driven.clock, Log(), end_ns=0, stop=never, turns_after_end=3, all_done=all_done)
    assert given.count(True) == min(others_turns + 4, real_time_loop._TURNS_TO_WAIT + 1)


def test_a_deadline_after_the_end_is_not_late() -> None:
    """The emulator may have packets in its queue for times after the end."""
    # The next deadline is after the first period, which is the end.
    driven = Slow(10**10, served=1)
    late_ns = run_loop(driven, driven, driven.clock, Log(), end_ns=1, stop=never)
    assert late_ns == 0
    assert driven.served < STEPS
