"""The real-time loop: a driver works in the core, and Python keeps house every 50 ms.

The driver waits for datagrams and absolute deadlines, and serves them. A missed deadline is served
late and in order; none is skipped.

Real-time settings of the process are applied where the system permits it, and reported. Measured
effect on the wake-up lateness of a 1 kHz loop (p50/p99, µs): none 80/184, shortest timer slack
30/145, SCHED_FIFO 38/106, no deep idle states 16/39.

All memory is locked, so that the loop does not wait for a page. Mappings of up to 16 MiB with code,
or with data that the process may write, are loaded beforehand. The larger ones are mostly unused:
buffers of BLAS (32 MiB each), of which the loop uses some pages. These are locked when they are
first used, as are constants of libraries. What the process shares with the fork server is not
copied beforehand: its pages are in memory, and the loop writes to few of them, each of which then
takes a microsecond. Nor are the stacks of other threads (2 MiB each) loaded, most of which is never
used.
"""

import ctypes
import gc
import os
import re
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import NamedTuple, Protocol, TypeVarTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.clock import NS_PER_S, RunClock
from noack.protocol.roles import LOOP_ROLES, Notice, Record

_HOUSEKEEPING_S = 0.05
_OVERLOAD_PAUSE_S = 0.002
_OVERLOAD_SHARE = 0.9  # of CPU time in the time since the last housekeeping
_TURNS_TO_CATCH_UP = 20
"""Of housekeeping, one second: a machine that is late at its end has this time to catch up."""
_TURNS_TO_WAIT = 2 * _TURNS_TO_CATCH_UP
"""Of housekeeping, for the others: they may be late, and then need a moment to say that they are
done."""
_PR_SET_TIMERSLACK = 29
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_MADV_POPULATE_READ, _MADV_POPULATE_WRITE = 22, 23
"""Constants of Linux, from <linux/prctl.h> and <sys/mman.h>."""
_LAST_PLACE = len(LOOP_ROLES) - 1
"""Place of the last process of the loop, which alone has the scenario's priority. Each earlier one
has a priority lower by 1."""
_CPU_DMA_LATENCY = Path("/dev/cpu_dma_latency")
_LARGE_BYTES = 16 * 2**20
_MAPPINGS = Path("/proc/self/smaps")
_MAPPING = re.compile(r"^([0-9a-f]+)-([0-9a-f]+) (...)(?s:.*?)^Shared_Dirty: +([0-9]+)", re.MULTILINE)


Arguments = TypeVarTuple("Arguments")


class RowSink(Protocol):
    """Where rows of the record go."""

    def extend_table(self, table: str, rows: NDArray[np.void]) -> None:
        """Add rows of a table."""


class RecordSink(RowSink, Protocol):
    """Where a machine's records and notices go."""

    def append(self, record: Record) -> None:
        """Add a row."""

    def notice(self, notice: Notice) -> None:
        """Add a line for the log."""

    def flush(self) -> None:
        """Publish the collected rows; called every 50 ms."""


class Driver(Protocol):
    """Drives the machines of a process: waits, receives, sends."""

    def set_clock(self, clock: RunClock) -> None:
        """Read the time as this clock does; called at the start and every 50 ms."""

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
    channel: ProcessSockets,
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

    Every 50 ms of wall time ``stop`` is asked. Before the first step and every 50 ms,
    ``external_inputs`` passes what does not come by sockets to the machines, and returns the outputs.

    The computer may not have run for a while before the end. So the loop goes on for up to a second
    while a deadline is missed, and for up to two seconds until ``all_done`` is true: it is told
    whether this process has done its work, and returns whether all processes of the run have. Then
    come ``turns_after_end`` turns of housekeeping, 50 ms each.

    Returns:
        How late the next deadline was at the end, in ns; 0 if it was not late, or if that
        deadline is after ``end_ns``.
    """
    period_ns = int(_HOUSEKEEPING_S * NS_PER_S * clock.speed)
    turns = turns_done = 0
    driver.set_clock(clock)
    _pass_on(external_inputs(clock.now_ns()), telemetry)
    channel.do_housekeeping(clock.now_ns(), telemetry)  # datagrams may have arrived before
    while True:
        began_s, began_cpu_s = time.monotonic(), time.thread_time()
        driver.drive(clock.now_ns() + period_ns, telemetry)
        cpu_s = time.thread_time() - began_cpu_s
        is_overloaded = cpu_s > _OVERLOAD_SHARE * (time.monotonic() - began_s)
        channel.do_housekeeping(clock.now_ns(), telemetry)
        _pass_on(external_inputs(clock.now_ns()), telemetry)
        driver.set_clock(clock)
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


@contextmanager
def realtime(enabled: bool, fifo_priority: int, place: int | None = None) -> Iterator[dict[str, str]]:
    """Apply the real-time settings to the calling thread, and undo them with the context.

    ``place`` counts the processes along the loop from 0, the plant. The plant has the first core,
    the others share the second: a message between them then needs no wake-up of another core. Each
    has a higher priority than the one before it, so that a receiver runs at once; the last has
    ``fifo_priority``. None leaves the core to the system.

    Yields:
        For each setting ``"applied"``, ``"not permitted: why"`` or ``"not requested"``.
    """
    settings = ("memory_lock", "timer_slack", "sched_fifo", "affinity", "cpu_dma_latency")
    applied = dict.fromkeys(settings, "not requested")
    with ExitStack() as undo:
        gc.collect()
        gc.freeze()
        gc.disable()
        undo.callback(gc.enable)
        if enabled:
            # Locking memory takes 0.1 s: at real-time priority it would block this core.
            applied["memory_lock"] = _attempt(lock_memory)
            applied["timer_slack"] = _attempt(_call_system, "prctl", _PR_SET_TIMERSLACK, 1, 0, 0, 0)
            applied["sched_fifo"] = _attempt(_fifo, fifo_priority, place, undo)
            if place is not None and applied["sched_fifo"] == "applied":
                applied["affinity"] = _attempt(_affinity, place, undo)
            applied["cpu_dma_latency"] = _attempt(_cpu_dma_latency, undo)
        yield applied


def _attempt(apply: Callable[[*Arguments], None], *arguments: *Arguments) -> str:
    try:
        apply(*arguments)
    except (OSError, AttributeError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        return f"not permitted: {reason}"
    return "applied"


def _fifo(priority: int, place: int | None, undo: ExitStack) -> None:
    if sys.platform != "linux":
        raise OSError(0, "not available on this system")
    loop = threading.get_native_id()
    rank = priority if place is None else priority - _LAST_PLACE + place
    os.sched_setscheduler(loop, os.SCHED_FIFO, os.sched_param(max(rank, 1)))
    undo.callback(os.sched_setscheduler, 0, os.SCHED_OTHER, os.sched_param(0))
    # The other threads (zenoh's) share locks with the loop; left at normal priority, one that is
    # preempted while it holds a lock would keep the loop waiting for milliseconds.
    rank = priority - _LAST_PLACE - 1
    for thread in {int(task.name) for task in Path("/proc/self/task").iterdir()} - {loop}:
        with suppress(ProcessLookupError):
            os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(max(rank, 1)))


def _affinity(place: int, undo: ExitStack) -> None:
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) < 2:
        raise OSError(0, "there is only one core")
    os.sched_setaffinity(0, {cores[min(place, 1)]})
    undo.callback(os.sched_setaffinity, 0, set(cores))


def _call_system(function: str, *arguments: int) -> None:
    if sys.platform != "linux":
        raise OSError(0, "not available on this system")
    if getattr(ctypes.CDLL(None, use_errno=True), function)(*arguments) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def _cpu_dma_latency(undo: ExitStack) -> None:
    # The kernel keeps the request for as long as the file stays open.
    descriptor = os.open(_CPU_DMA_LATENCY, os.O_WRONLY)
    undo.callback(os.close, descriptor)
    os.write(descriptor, struct.pack("i", 0))


def lock_memory() -> None:
    """Lock the memory of this process, now and in the future.

    Raises:
        OSError: it is not permitted.
    """
    _call_system("mlockall", _MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT)
    madvise = ctypes.CDLL(None).madvise
    for mapping in _mappings():
        if mapping.bytes <= _LARGE_BYTES:
            # Fails for special mappings, and before Linux 5.14: then each page is locked at its use
            madvise(ctypes.c_void_p(mapping.first), ctypes.c_size_t(mapping.bytes), mapping.advice)


class _Mapping(NamedTuple):
    """Memory of this process that is loaded."""

    first: int
    bytes: int
    advice: int


def _mappings() -> Iterator[_Mapping]:
    """Yield the code, and what this process alone may write."""
    guard_end = 0
    for match in _MAPPING.finditer(_MAPPINGS.read_text()):
        first, end, rights = int(match[1], 16), int(match[2], 16), match[3]
        is_stack = guard_end == first
        if rights == "---":  # a thread's stack begins with such a guard
            guard_end = end
        elif rights[2] == "x":
            yield _Mapping(first, end - first, _MADV_POPULATE_READ)
        elif rights[1] == "w" and not is_stack and match[4] == "0":
            yield _Mapping(first, end - first, _MADV_POPULATE_WRITE)
