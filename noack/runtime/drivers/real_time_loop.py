"""The real-time loop: a driver works in the core, and Python keeps house every 50 ms.

The driver waits for datagrams and absolute deadlines, and serves them. A missed deadline is served
late and in order; none is skipped.
"""

import time
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from netem.core.clock import NS_PER_S, RunClock
from noack.protocol.roles import Notice, Record

_HOUSEKEEPING_S = 0.05
"""Wall time between two turns of housekeeping."""
_OVERLOAD_PAUSE_S = 0.002
"""Pause for other threads, after a turn in which the loop has used nearly all time of its core."""
_OVERLOAD_SHARE = 0.9  # of CPU time in the time since the last housekeeping
_TURNS_TO_CATCH_UP = 20
"""Turns of housekeeping (one second) that a machine which is late at its end has to catch up."""
_TURNS_TO_WAIT = 2 * _TURNS_TO_CATCH_UP
"""Turns of housekeeping for which a process that is done waits for the others, which may be late and
report their end a moment later."""


class RowSink(Protocol):
    """Receives rows of the record."""

    def extend_table(self, table: str, rows: NDArray[np.void]) -> None:
        """Add rows of a table."""


class RecordSink(RowSink, Protocol):
    """Receives a machine's records and notices."""

    def append(self, record: Record) -> None:
        """Add a row."""

    def notice(self, notice: Notice) -> None:
        """Add a line for the log."""

    def flush(self) -> None:
        """Publish the collected rows; called every 50 ms."""


class Driver(Protocol):
    """Drives the machines of a process: waits, receives, sends."""

    def set_clock(self, clock: RunClock) -> None:
        """Read the time as this clock does; called at the start."""

    def drive(self, until_ns: int, sink: RecordSink) -> None:
        """Work until about simulated time ``until_ns``; pass on the rows of the record."""

    def next_deadline_ns(self) -> int | None:
        """When the next work is due; None if there is none."""


class ProcessSockets(Protocol):
    """The sockets of a process."""

    def do_housekeeping(self, now_ns: int, sink: RecordSink) -> None:
        """Do its own housekeeping, every 50 ms."""


def run_loop(
    driver: Driver,
    sockets: ProcessSockets,
    clock: RunClock,
    telemetry: RecordSink,
    *,
    end_ns: int | None,
    stop: Callable[[], bool],
    turns_after_end: int = 0,
    all_done: Callable[[bool], bool] = lambda is_done: is_done,
    external_inputs: Callable[[int], Sequence[Record | Notice]] = lambda now_ns: (),
) -> int:
    """Drive until simulated time ``end_ns`` (None: no end), or until ``stop()``.

    Every 50 ms of wall time ``stop`` is called. Before the first step and every 50 ms,
    ``external_inputs`` passes what does not come by sockets to the machines, and returns the outputs.

    The computer may not have run for a while before the end. So the loop goes on for up to a second
    while a deadline is missed, and for up to two seconds until ``all_done`` is true. It is called
    with whether this process has done its work, and returns whether all processes of the run have.
    Then come ``turns_after_end`` turns of housekeeping, 50 ms each.

    Returns:
        How late the next deadline was at the end, in ns; 0 if it was not late, or if that
        deadline is after ``end_ns``.
    """
    period_ns = int(_HOUSEKEEPING_S * NS_PER_S * clock.speed)
    turns = turns_done = 0
    driver.set_clock(clock)
    _pass_on(external_inputs(clock.now_ns()), telemetry)
    sockets.do_housekeeping(clock.now_ns(), telemetry)  # datagrams may have arrived before
    while True:
        began_s, began_cpu_s = time.monotonic(), time.thread_time()
        driver.drive(clock.now_ns() + period_ns, telemetry)
        cpu_s = time.thread_time() - began_cpu_s
        is_overloaded = cpu_s > _OVERLOAD_SHARE * (time.monotonic() - began_s)
        sockets.do_housekeeping(clock.now_ns(), telemetry)
        _pass_on(external_inputs(clock.now_ns()), telemetry)
        telemetry.flush()
        if is_overloaded:
            # At real-time priority no other thread would get this core, not even the one that
            # keeps this process's connection to the control plane alive.
            time.sleep(_OVERLOAD_PAUSE_S)
        now_ns, deadline_ns = clock.now_ns(), driver.next_deadline_ns()
        if end_ns is not None and deadline_ns is not None and deadline_ns > end_ns:
            deadline_ns = None  # not part of the run
        late_ns = 0 if deadline_ns is None else max(now_ns - deadline_ns, 0)
        if end_ns is not None and now_ns >= end_ns:
            turns += 1
            turns_done += all_done(not late_ns)
        most = _TURNS_TO_CATCH_UP if late_ns else _TURNS_TO_WAIT
        if stop() or turns_done > turns_after_end or turns > most:
            return late_ns


def _pass_on(outputs: Sequence[Record | Notice], sink: RecordSink) -> None:
    for output in outputs:
        if isinstance(output, Record):
            sink.append(output)
        else:
            sink.notice(output)
