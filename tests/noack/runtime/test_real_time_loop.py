"""The real-time loop with a socket that always has datagrams."""

import os
import time
from collections.abc import Iterator, Sequence

import pytest

from noack.core.clock import RunClock
from noack.protocol.machine_interface import Notice, Record
from noack.runtime.real_time_loop import run_loop

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
        self.watched = (readable,)
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

    def append(self, record: Record) -> None: ...

    def notice(self, notice: Notice) -> None:
        self.lines.append(notice.text)

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
