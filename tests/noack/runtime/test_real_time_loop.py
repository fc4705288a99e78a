"""The real-time loop with a socket that always has datagrams."""

import os
import select
import time
from collections.abc import Iterator, Sequence
from itertools import count
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from noack.core.clock import RunClock
from noack.protocol.machine_interface import Notice, Record
from noack.runtime import real_time_loop
from noack.runtime.real_time_loop import RowSink, run_loop

PERIOD_NS = 1_000_000
STEPS = 200


class Ticker:
    """A machine with a deadline every millisecond."""

    def __init__(self) -> None:
        self.served = 0

    def next_deadline_ns(self) -> int | None:
        return self.served * PERIOD_NS if self.served < STEPS else None

    def on_timer(self, now_ns: int) -> Sequence[Notice]:
        self.served += 1
        return ()

    def handle(self, message: Notice, now_ns: int) -> Sequence[Notice]:
        raise AssertionError("junk was taken for a message")


class Flooded:
    """A channel that always has datagrams and never a valid message."""

    def __init__(self, readable: int, clock: RunClock, ticker: Ticker) -> None:
        self.watched: Sequence[int] = (readable,)
        self._clock = clock
        self._ticker = ticker
        self._overdue: int | None = None
        self.looks = 0
        self.passed_over = 0

    def receive(self, readable: int) -> None:
        assert readable == self.watched[0]
        self.looks += 1
        # Counts a deadline that was due at the last read and has not been served since.
        self.passed_over += self._overdue is not None and self._overdue == self._ticker.served
        due_ns = self._ticker.next_deadline_ns()
        is_due = due_ns is not None and self._clock.now_ns() >= due_ns
        self._overdue = self._ticker.served if is_due else None

    def send(self, message: Notice) -> None:
        raise AssertionError("nothing was to be sent")

    def tend(self, now_ns: int) -> Sequence[Notice]:
        return (Notice(now_ns, "info", "tended"),)


class Log:
    """Receives the loop's output."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.rows: list[int] = []

    def append(self, record: Record) -> None: ...

    def notice(self, notice: Notice) -> None:
        self.lines.append(notice.text)

    def extend_table(self, table: str, rows: NDArray[Any]) -> None:
        self.rows.append(len(rows))

    def flush(self) -> None: ...


@pytest.fixture
def always_readable() -> Iterator[int]:
    out, into = os.pipe()
    os.write(into, b"x")
    yield out
    os.close(out)
    os.close(into)


def test_deadlines_are_served_while_junk_arrives(always_readable: int) -> None:
    clock, ticker, log = RunClock(time.monotonic_ns()), Ticker(), Log()
    channel = Flooded(always_readable, clock, ticker)
    run_loop(ticker, channel, clock, log, end_ns=STEPS * PERIOD_NS, stop=lambda: False)
    assert ticker.served > 0  # and all of them, if nothing else uses the processor
    assert channel.looks > 0
    assert channel.passed_over == 0
    assert set(log.lines) == {"tended"}


class Counting:
    """A channel whose n-th message is n, and a machine that answers the even ones.

    Its deadline is always ``left_ns`` ahead; None: it has none.
    """

    def __init__(self, readable: int, clock: RunClock, left_ns: int | None) -> None:
        self.watched: Sequence[int] = (readable,)
        self._clock, self._left_ns = clock, left_ns
        self.received = 0
        self.sent: list[int] = []

    def receive(self, readable: int) -> int:
        self.received += 1
        return self.received

    def send(self, message: int) -> None:
        self.sent.append(message)

    def tend(self, now_ns: int) -> Sequence[Notice]:
        return ()

    def next_deadline_ns(self) -> int | None:
        return None if self._left_ns is None else self._clock.now_ns() + self._left_ns

    def on_timer(self, now_ns: int) -> Sequence[Record]:
        return ()  # nothing is due, unless this thread did not run for a while

    def handle(self, message: int, now_ns: int) -> Sequence[int]:
        return (message,) if message % 2 == 0 else ()


class Rehearsed:
    """Keeps the numbers of the messages after which it was called."""

    def __init__(self, both: Counting) -> None:
        self._both = both
        self.rehearsed, self.postponed = list[int](), list[int]()

    def rehearse(self) -> None:
        self.rehearsed.append(self._both.received)

    def postpone(self) -> None:
        self.postponed.append(self._both.received)


@pytest.mark.parametrize("left_ns", [None, 10**9])
def test_a_loop_rehearses_unless_it_has_just_done_what_is_rare(
    always_readable: int, left_ns: int | None
) -> None:
    """An answer is rare; in a process with deadlines, each message is."""
    clock, log = RunClock(time.monotonic_ns()), Log()
    both = Counting(always_readable, clock, left_ns)
    rehearsal = Rehearsed(both)
    run_loop(
        both, both, clock, log, end_ns=None, stop=lambda: both.received > 1, rehearsal=rehearsal
    )
    numbers = range(1, both.received + 1)
    assert both.sent == [number for number in numbers if number % 2 == 0]
    odd = [number for number in numbers if number % 2 and left_ns is None]
    assert rehearsal.rehearsed == odd
    assert rehearsal.postponed == [number for number in numbers if number not in odd]


class Stepping(Counting):
    """A channel without messages, and a machine whose next step is always ``left_ns`` ahead."""

    def __init__(self, readable: int, clock: RunClock, left_ns: int) -> None:
        super().__init__(readable, clock, left_ns)
        self.watched = ()

    def next_deadline_ns(self) -> int | None:
        return super().next_deadline_ns() if self.received else 0

    def on_timer(self, now_ns: int) -> Sequence[Record]:
        self.received += 1
        return ()


@pytest.mark.parametrize(("left_ns", "rehearsed"), [(10**10, [1]), (100_000, [])])
def test_a_loop_rehearses_after_a_step_unless_the_next_is_near(
    left_ns: int, rehearsed: list[int]
) -> None:
    clock, log = RunClock(time.monotonic_ns()), Log()
    both = Stepping(0, clock, left_ns)
    rehearsal = Rehearsed(both)
    run_loop(
        both, both, clock, log, end_ns=None, stop=lambda: both.received > 0, rehearsal=rehearsal
    )
    assert rehearsal.rehearsed == rehearsed
    assert rehearsal.postponed == []


class SelfDriven:
    """A machine that drives itself, and the channel that it uses."""

    watched: Sequence[int] = ()

    def __init__(self, steps: list[str]) -> None:
        self.steps = steps
        self.periods_ns: list[int] = []
        self.clock = RunClock(time.monotonic_ns(), 3.0)

    def drive(self, until_ns: int, rows: RowSink) -> None:
        self.steps.append("drive")
        self.periods_ns.append(until_ns - self.clock.now_ns())
        rows.extend_table("table", np.zeros(len(self.periods_ns), np.int64))

    def tend(self, now_ns: int) -> Sequence[Notice]:
        self.steps.append("tend")
        return ()

    def next_deadline_ns(self) -> int | None:
        return -5

    def receive(self, readable: int) -> None: ...

    def send(self, message: None) -> None: ...

    def on_timer(self, now_ns: int) -> Sequence[None]:
        raise AssertionError("it drives itself")

    def handle(self, message: None, now_ns: int) -> Sequence[None]:
        raise AssertionError("it drives itself")


@pytest.mark.parametrize("busy", [False, True])
def test_a_machine_may_drive_itself_between_two_turns_of_housekeeping(
    busy: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps, pauses, log = list[str](), list[float](), Log()
    monkeypatch.setattr(time, "sleep", pauses.append)
    cpu_s = count(0, 10**6 if busy else 0)
    monkeypatch.setattr(time, "thread_time", lambda: next(cpu_s))
    one = SelfDriven(steps)
    late_ns = run_loop(
        one, one, one.clock, log, end_ns=None, stop=lambda: steps.append("stop") or len(steps) > 9,
        news=lambda now_ns: steps.append("news") or (),
    )  # fmt: skip
    turn = ["drive", "tend", "news", "stop"]
    assert steps == ["news", "tend", *turn, *turn]
    assert log.rows == [1, 2]
    assert all(period_ns <= 0.05e9 * 3.0 for period_ns in one.periods_ns)
    assert late_ns > 5
    # A busy machine leaves the core to the other threads for a moment.
    assert len(pauses) == (2 if busy else 0)


class Late(Ticker):
    """Records how late its steps are."""

    def __init__(self) -> None:
        super().__init__()
        self.late_ns: list[int] = []

    def on_timer(self, now_ns: int) -> Sequence[Notice]:
        self.late_ns.append(now_ns - self.served * PERIOD_NS)
        return super().on_timer(now_ns)


class Slow(Late):
    """Each step takes a millisecond."""

    def on_timer(self, now_ns: int) -> Sequence[Notice]:
        time.sleep(PERIOD_NS * 1e-9)
        return super().on_timer(now_ns)


@pytest.mark.parametrize("turns", [20, 0])
def test_a_machine_that_is_late_at_its_end_catches_up_for_a_while(
    always_readable: int, turns: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The computer did not run for ten seconds; its steps take two turns or more."""
    monkeypatch.setattr(real_time_loop, "_TURNS_TO_CATCH_UP", turns)
    clock, machine = RunClock(time.monotonic_ns() - 10**10), Slow()
    channel = Flooded(always_readable, clock, machine)
    end_ns = STEPS * PERIOD_NS
    late_ns = run_loop(machine, channel, clock, Log(), end_ns=end_ns, stop=lambda: False)
    assert (machine.served == STEPS) == (late_ns == 0) == (turns == 20)


def test_a_deadline_after_the_end_is_not_late(always_readable: int) -> None:
    """The emulator may have packets in its queue for times after the end."""
    clock, machine = RunClock(time.monotonic_ns() - 10**10), Slow()
    machine.served = 1  # the next deadline is after the first period, which is the end
    channel = Flooded(always_readable, clock, machine)
    late_ns = run_loop(machine, channel, clock, Log(), end_ns=1, stop=lambda: False)
    assert late_ns == 0
    assert machine.served < STEPS


@pytest.mark.parametrize("others_turns", [0, 7, 10**9])
def test_a_machine_that_is_done_waits_for_the_others_for_a_while(
    always_readable: int, others_turns: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(real_time_loop, "_HOUSEKEEPING_S", 0.0)
    clock, machine, told = RunClock(time.monotonic_ns()), Ticker(), list[bool]()
    machine.served = STEPS
    channel = Flooded(always_readable, clock, machine)

    def all_done(done: bool) -> bool:
        told.append(done)
        return done and told.count(True) > others_turns

    run_loop(
        machine, channel, clock, Log(), end_ns=0, stop=lambda: False,
        turns_after_end=3, all_done=all_done,
    )  # fmt: skip
    assert told.count(True) == min(others_turns + 4, real_time_loop._TURNS_TO_WAIT + 1)


def test_deadlines_are_gathered_and_never_served_early(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 200 deadlines in 0.2 s, some 20 are served at each waking up."""
    clock, machine = RunClock(time.monotonic_ns() + 50 * PERIOD_NS), Late()
    waits_s: list[float] = []

    def wait(*arguments: Any) -> Any:
        waits_s.append(arguments[-1])
        return original(*arguments)

    original = select.select
    monkeypatch.setattr(select, "select", wait)
    out, into = os.pipe()  # nothing arrives
    run_loop(
        machine, Flooded(out, clock, machine), clock, Log(), end_ns=STEPS * PERIOD_NS,
        stop=lambda: False, gather_ns=20 * PERIOD_NS,
    )  # fmt: skip
    os.close(out)
    os.close(into)
    assert min(machine.late_ns) >= 0
    assert sum(one_s > 0 for one_s in waits_s) < STEPS // 4
