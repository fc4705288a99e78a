"""The real-time loop: drives a machine from a socket and a clock.

One thread waits in ``select`` for the socket or the next absolute deadline, whichever comes first.
The timeout of select has microsecond steps; the timers of asyncio and epoll have millisecond steps.
A missed deadline is served late and in order; none is skipped. A :class:`SelfDrivenMachine` does
all this itself between two turns of housekeeping.
"""

import os
import select
import time
from collections.abc import Callable, Sequence
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

from numpy.typing import NDArray

from noack.core.clock import NS_PER_S, RunClock
from noack.protocol.machine_interface import Machine, Notice, Record

T = TypeVar("T")

_HOUSEKEEPING_S = 0.05
_OVERLOAD_PAUSE_S = 0.002
_OVERLOAD_SHARE = 0.9  # of CPU time in the time since the last housekeeping
_TURNS_TO_CATCH_UP = 20
"""Of housekeeping, one second: a machine that is late at its end has this time to catch up."""
_TURNS_TO_WAIT = 2 * _TURNS_TO_CATCH_UP
"""Of housekeeping, for the others: they may be late, and then need a moment to say that they are
done."""
_QUIET_S = 0.0005
"""Housekeeping and rehearsals take 0.1 to 0.2 ms; they wait when the deadline is nearer."""
_yield_core: Callable[[], None] = getattr(os, "sched_yield", lambda: None)
"""After a rejected datagram: lets other threads of the same real-time priority run first."""


class Channel(Protocol[T]):
    """Where a machine's messages come from and go to."""

    @property
    def watched(self) -> Sequence[int]:
        """File descriptors to wait on now, the most important first."""
        ...

    def receive(self, readable: int) -> T | None:
        """Return one message from a file descriptor; read at most a few datagrams that are none."""
        ...

    def send(self, message: T) -> None:
        """Send a message; never blocks, and never raises because of a peer."""
        ...

    def tend(self, now_ns: int) -> Sequence[Record | Notice]:
        """Do its own housekeeping, every 50 ms; return rows, and lines for the log."""
        ...


class RowSink(Protocol):
    """Where rows of the record go."""

    def extend_table(self, table: str, rows: NDArray[Any]) -> None:
        """Add rows of a table."""
        ...


class RecordSink(RowSink, Protocol):
    """Where a machine's records and notices go."""

    def append(self, record: Record) -> None:
        """Add a row."""
        ...

    def notice(self, notice: Notice) -> None:
        """Add a line for the log."""
        ...

    def flush(self) -> None:
        """Publish the collected rows; called every 50 ms."""
        ...


class Rehearsing(Protocol):
    """Rehearses what a process does rarely; see :mod:`noack.runtime.rehearsal`."""

    def rehearse(self) -> None:
        """Rehearse, unless it was a moment ago."""
        ...

    def postpone(self) -> None:
        """Rehearse no more for a while."""
        ...


@runtime_checkable
class SelfDrivenMachine(Protocol):
    """A machine that waits for its deadlines and messages itself, and sends its messages."""

    def drive(self, until_ns: int, sink: RecordSink) -> None:
        """Work until about simulated time ``until_ns``; pass on its rows of the record."""
        ...


def run_loop(
    machine: Machine[T],
    channel: Channel[T],
    clock: RunClock,
    telemetry: RecordSink,
    *,
    end_ns: int | None,
    stop: Callable[[], bool],
    turns_after_end: int = 0,
    all_done: Callable[[bool], bool] = lambda done: done,
    spin_us: float = 0.0,
    gather_ns: int = 0,
    rehearsal: Rehearsing | None = None,
    news: Callable[[int], Sequence[Record | Notice]] = lambda now_ns: (),
) -> int:
    """Drive ``machine`` until simulated time ``end_ns`` (None: no end), or until ``stop()``.

    Every 50 ms of wall time ``stop`` is asked. Before the first step and every 50 ms, ``news``
    passes input from outside the socket to the machine and returns the machine's outputs. The
    loop busy-waits for the last ``spin_us`` before a deadline. It may wait ``gather_ns`` longer, to
    serve the deadlines of that time together. It rehearses between its steps, unless a deadline is
    near.

    The computer may not have run for a while before the end. So the loop goes on for up to a second
    while the machine is late, and for up to two seconds until ``all_done`` is true: it is told
    whether this machine has done its work, and returns whether all machines of the run have. Then
    come ``turns_after_end`` turns of housekeeping, 50 ms each.

    Returns:
        How late the machine's next deadline was at the end, in ns; 0 if it was not late, or if that
        deadline is after ``end_ns``.
    """
    kind = _SelfDrivenLoop if isinstance(machine, SelfDrivenMachine) else _Loop
    loop: _Loop[T] = kind(machine, channel, clock, telemetry, spin_us * 1e-6, news)
    loop.gather_ns = gather_ns
    loop.rehearsal = rehearsal
    # Looked up once: after milliseconds of sleep the code runs cold, and every step counts.
    step, housekeeping_is_due = loop.step, loop.housekeeping_is_due
    turns = turns_done = 0
    while True:
        step()
        if housekeeping_is_due():
            loop.do_housekeeping()
            now_ns, deadline_ns = clock.now_ns(), machine.next_deadline_ns()
            if end_ns is not None and deadline_ns is not None and deadline_ns > end_ns:
                deadline_ns = None  # not part of the run
            late_ns = 0 if deadline_ns is None else max(now_ns - deadline_ns, 0)
            if end_ns is not None and now_ns >= end_ns:
                turns += 1
                turns_done += all_done(not late_ns)
            most = _TURNS_TO_CATCH_UP if late_ns else _TURNS_TO_WAIT
            if stop() or turns_done > turns_after_end or turns > most:
                return late_ns
            loop.schedule_housekeeping()


class _Loop(Generic[T]):
    """The parts of one turn of the loop."""

    def __init__(
        self,
        machine: Machine[T],
        channel: Channel[T],
        clock: RunClock,
        telemetry: RecordSink,
        spin_s: float,
        news: Callable[[int], Sequence[Record | Notice]],
    ) -> None:
        self._channel, self._telemetry, self._news = channel, telemetry, news
        self._handle, self._on_timer = machine.handle, machine.on_timer
        self._next_deadline_ns = machine.next_deadline_ns
        self._now_ns, self._wall_s_until = clock.now_ns, clock.wall_s_until
        self._spin_s = spin_s
        self.rehearsal: Rehearsing | None = None
        self.gather_ns = 0
        self._slept = False
        """Whether the loop has waited since the last housekeeping."""
        self._emit(news(clock.now_ns()))
        self.schedule_housekeeping()
        self._begin(machine, clock)

    def _begin(self, machine: Machine[T], clock: RunClock) -> None:
        """Prepare what only a subclass needs."""

    def schedule_housekeeping(self) -> None:
        """Set the time of the next housekeeping."""
        self._slept = False
        self._housekeeping_s = time.monotonic() + _HOUSEKEEPING_S

    def step(self) -> None:
        """Serve the deadline if it is due, or wait for it; then read the socket once."""
        deadline_ns = self._next_deadline_ns()
        if deadline_ns is not None and self._now_ns() >= deadline_ns:
            self._emit(self._on_timer(self._now_ns()))
            self._rehearse()
            wait_s = 0.0  # the socket is read between late steps, so that it never starves
        else:
            wait_s = self._housekeeping_s - time.monotonic()
            if deadline_ns is not None:
                left_s = self._wall_s_until(deadline_ns + self.gather_ns) - self._spin_s
                # Housekeeping that is due too near the deadline is done after it.
                wait_s = left_s if wait_s <= 0 else min(left_s, wait_s)
            wait_s = max(wait_s, 0.0)
        readable, _, _ = select.select(self._channel.watched, (), (), wait_s)
        if readable:
            message = self._channel.receive(readable[0])
            if message is not None:
                sends = self._emit(self._handle(message, self._now_ns()))
                if sends or self._next_deadline_ns() is not None:
                    self._postpone()
                else:
                    self._rehearse()
            else:
                _yield_core()
        elif wait_s > 0:
            self._slept = True

    def _rehearse(self) -> None:
        if self.rehearsal is not None and self._is_quiet():
            self.rehearsal.rehearse()

    def _postpone(self) -> None:
        """The rare path was taken: a sensor has sent, or a process with a deadline has received."""
        if self.rehearsal is not None:
            self.rehearsal.postpone()

    def _is_quiet(self) -> bool:
        """Whether no deadline is near."""
        deadline_ns = self._next_deadline_ns()
        return deadline_ns is None or self._wall_s_until(deadline_ns) > _QUIET_S

    def housekeeping_is_due(self) -> bool:
        """Whether its time has come and no deadline is near, or it is a whole period late."""
        overdue_s = time.monotonic() - self._housekeeping_s
        if overdue_s < 0:
            return False
        return self._is_quiet() or overdue_s > _HOUSEKEEPING_S

    def do_housekeeping(self) -> None:
        """Look after the channel, pass news on, publish the rows."""
        self._emit(self._channel.tend(self._now_ns()))
        self._emit(self._news(self._now_ns()))
        self._telemetry.flush()
        if not self._slept:
            # Overload: at real-time priority no other thread would get this core, not even the one
            # that keeps this process's connection to the control plane alive.
            time.sleep(_OVERLOAD_PAUSE_S)

    def _emit(self, outputs: Sequence[T | Record | Notice]) -> bool:
        """Pass the outputs on; return whether one was a message."""
        sends = False
        for output in outputs:
            if isinstance(output, Record):
                self._telemetry.append(output)
            elif isinstance(output, Notice):
                self._telemetry.notice(output)
            else:
                self._channel.send(output)
                sends = True
        return sends


class _SelfDrivenLoop(_Loop[T]):
    """The loop of a machine that drives itself between two turns of housekeeping."""

    def _begin(self, machine: Machine[T], clock: RunClock) -> None:
        assert isinstance(machine, SelfDrivenMachine)
        self._drive = machine.drive
        self._period_ns = int(_HOUSEKEEPING_S * NS_PER_S * clock.speed)
        self._emit(self._channel.tend(clock.now_ns()))  # messages may have arrived before

    def step(self) -> None:
        """Let the machine work until the next housekeeping, which it puts off if it is busy."""
        began_s, began_cpu_s = time.monotonic(), time.thread_time()
        self._drive(self._now_ns() + self._period_ns, self._telemetry)
        cpu_s = time.thread_time() - began_cpu_s
        self._slept = cpu_s < _OVERLOAD_SHARE * (time.monotonic() - began_s)

    def housekeeping_is_due(self) -> bool:
        """Whether it is due: always after a step."""
        return True
