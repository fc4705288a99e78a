"""The real-time loop: drives a machine from a socket and a clock.

One thread waits in ``select`` for the socket or the next absolute deadline, whichever comes first.
select's timeout has microsecond steps; asyncio's and epoll's timers have milliseconds. A deadline
that was missed is served late and in order, never skipped.
"""

import os
import select
import time
from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

from noack.core.clock import RunClock
from noack.protocol.machine_interface import Machine, Notice, Record

T = TypeVar("T")

_HOUSEKEEPING_S = 0.05
_BREATH_S = 0.002
_QUIET_S = 0.0005
"""Housekeeping takes a tenth of a millisecond and is kept this far from the next deadline."""
_give_way: Callable[[], None] = getattr(os, "sched_yield", lambda: None)
"""Lets others of the same real-time priority go first: junk is never as urgent as they are."""


class Channel(Protocol[T]):
    """Where a machine's messages come from and go to."""

    @property
    def watched(self) -> Sequence[int]:
        """File descriptors to wait on now, the most important first."""
        ...

    def receive(self, readable: int) -> T | None:
        """Take one message from a file descriptor; None if there was none worth taking.

        Work is bounded: of what is not worth taking it looks at a few in a row at the most.
        """
        ...

    def send(self, message: T) -> None:
        """Send a message; never blocks and never raises for a peer's fault."""
        ...

    def tend(self, now_ns: int) -> Sequence[Notice]:
        """See to itself, called every 50 ms; returns lines for the log."""
        ...


class RecordSink(Protocol):
    """Where a machine's records and notices go."""

    def append(self, record: Record) -> None:
        """Take a row."""
        ...

    def notice(self, notice: Notice) -> None:
        """Take a line for the log."""
        ...

    def flush(self) -> None:
        """Hand over what has been gathered; called every 50 ms."""
        ...


def run_loop(
    machine: Machine[T],
    channel: Channel[T],
    clock: RunClock,
    telemetry: RecordSink,
    *,
    end_ns: int | None,
    stop: Callable[[], bool],
    spin_us: float = 0.0,
    news: Callable[[int], Sequence[Record | Notice]] = lambda now_ns: (),
) -> int:
    """Drive ``machine`` until simulated time ``end_ns``, or until ``stop()``.

    Args:
        machine: the pure machine.
        channel: its socket.
        clock: simulated time.
        telemetry: takes its records and notices.
        end_ns: when to end; None runs until stopped.
        stop: asked every 50 ms of wall time.
        spin_us: busy-wait for the last microseconds before a deadline.
        news: tells the machine what has become known beside its socket, before the first step and
            every 50 ms; what it answers goes on record.

    Returns:
        By how much the machine was behind its deadlines at the end, in ns; 0 if it was not.
    """
    spin_s = spin_us * 1e-6
    # Looked up once: after milliseconds of sleep the code runs cold, and every step counts.
    receive, send, handle, on_timer = (
        channel.receive,
        channel.send,
        machine.handle,
        machine.on_timer,
    )
    next_deadline_ns, now_ns, wall_s_until = (
        machine.next_deadline_ns,
        clock.now_ns,
        clock.wall_s_until,
    )

    def emit(outputs: Sequence[T | Record | Notice]) -> None:
        for output in outputs:
            if isinstance(output, Record):
                telemetry.append(output)
            elif isinstance(output, Notice):
                telemetry.notice(output)
            else:
                send(output)

    emit(news(now_ns()))
    housekeeping_s = time.monotonic() + _HOUSEKEEPING_S
    rested = False
    while True:
        deadline_ns = next_deadline_ns()
        if deadline_ns is not None and now_ns() >= deadline_ns:
            emit(on_timer(now_ns()))
            wait_s = 0.0  # look at the socket between late steps, so that it is never starved
        else:
            wait_s = housekeeping_s - time.monotonic()
            if deadline_ns is not None:
                left_s = wall_s_until(deadline_ns) - spin_s
                # Housekeeping that came due too near the deadline waits until that is over.
                wait_s = left_s if wait_s <= 0 else min(left_s, wait_s)
            wait_s = max(wait_s, 0.0)
        readable, _, _ = select.select(channel.watched, (), (), wait_s)
        rested = rested or (wait_s > 0 and not readable)
        if readable:
            message = receive(readable[0])
            if message is not None:
                emit(handle(message, now_ns()))
            else:
                _give_way()
        overdue_s = time.monotonic() - housekeeping_s
        if overdue_s < 0:
            continue
        deadline_ns = next_deadline_ns()
        quiet = deadline_ns is None or wall_s_until(deadline_ns) > _QUIET_S
        if quiet or overdue_s > _HOUSEKEEPING_S:
            emit(channel.tend(now_ns()))
            emit(news(now_ns()))
            telemetry.flush()
            if not rested:
                # Overloaded: at real-time priority nobody else would get this core any more, not
                # even the thread that keeps this process's connection to the control plane alive.
                time.sleep(_BREATH_S)
            rested = False
            if stop() or (end_ns is not None and now_ns() >= end_ns):
                return 0 if deadline_ns is None else max(now_ns() - deadline_ns, 0)
            housekeeping_s = time.monotonic() + _HOUSEKEEPING_S
