"""Real-time settings of a process: memory, timers, priority, core, idle states.

They are applied where the system permits it, and reported. Measured effect on the wake-up lateness
of a 1 kHz loop (p50/p99, µs): none 80/184, shortest timer slack 30/145, SCHED_FIFO 38/106, no deep
idle states 16/39.

All memory is locked, so that the loop does not wait for a page. Mappings of up to 16 MiB with code,
or with data that the process may write, are loaded beforehand. The larger ones are mostly unused:
buffers of BLAS (32 MiB each), of which the loop uses some pages. These are locked when they are
first used, as are constants of libraries. What the process shares with the one that it was forked from is not
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
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import NamedTuple, TypeVarTuple

_PR_SET_TIMERSLACK = 29
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_MADV_POPULATE_READ, _MADV_POPULATE_WRITE = 22, 23
"""Constants of Linux and glibc, from <linux/prctl.h>, <sys/mman.h> and <malloc.h>."""
_CPU_DMA_LATENCY = Path("/dev/cpu_dma_latency")
_LARGE_BYTES = 16 * 2**20
_KEPT_BYTES = 32 * 2**20
"""Freed memory that the process keeps: batches of rows would else need new pages, a microsecond each."""
_MAPPINGS = Path("/proc/self/smaps")
_MAPPING = re.compile(r"^([0-9a-f]+)-([0-9a-f]+) (...)(?s:.*?)^Shared_Dirty: +([0-9]+)", re.MULTILINE)

Arguments = TypeVarTuple("Arguments")


@contextmanager
def realtime(
    enabled: bool, fifo_priority: int, place: int | None = None, places: int = 1
) -> Iterator[dict[str, str]]:
    """Apply the real-time settings to the calling thread, and undo them with the context.

    ``place`` counts the processes along a loop of ``places`` processes from 0. The first process has
    the first core, the others share the second: a message between them then needs no wake-up of
    another core. Each has a higher priority than the one before it, so that a receiver runs at once;
    the last has ``fifo_priority``. None leaves the core to the system.

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
            applied["sched_fifo"] = _attempt(_set_fifo_priority, fifo_priority, place, places, undo)
            if place is not None and applied["sched_fifo"] == "applied":
                applied["affinity"] = _attempt(_set_affinity, place, undo)
            applied["cpu_dma_latency"] = _attempt(_set_cpu_dma_latency, undo)
        yield applied


def _attempt(apply: Callable[[*Arguments], None], *arguments: *Arguments) -> str:
    try:
        apply(*arguments)
    except (OSError, AttributeError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        return f"not permitted: {reason}"
    return "applied"


def _set_fifo_priority(priority: int, place: int | None, places: int, undo: ExitStack) -> None:
    if sys.platform != "linux":
        raise OSError(0, "not available on this system")
    loop = threading.get_native_id()
    rank = priority if place is None else priority - places + 1 + place
    os.sched_setscheduler(loop, os.SCHED_FIFO, os.sched_param(max(rank, 1)))
    undo.callback(os.sched_setscheduler, 0, os.SCHED_OTHER, os.sched_param(0))
    # The other threads (such as zenoh's) share locks with the loop; left at normal priority, one that is
    # preempted while it holds a lock would keep the loop waiting for milliseconds.
    rank = priority - places
    for thread in {int(task.name) for task in Path("/proc/self/task").iterdir()} - {loop}:
        with suppress(ProcessLookupError):
            os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(max(rank, 1)))


def _set_affinity(place: int, undo: ExitStack) -> None:
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


def _set_cpu_dma_latency(undo: ExitStack) -> None:
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
    library = ctypes.CDLL(None)
    with suppress(AttributeError):  # not glibc
        for threshold in (_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD):
            library.mallopt(threshold, _KEPT_BYTES)
    for mapping in _mappings():
        if mapping.bytes <= _LARGE_BYTES:
            # Fails for special mappings, and before Linux 5.14: then each page is locked at its use
            library.madvise(ctypes.c_void_p(mapping.first), ctypes.c_size_t(mapping.bytes), mapping.advice)


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
