"""Where and before whom the load and the relays run."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

_CORES = sorted(os.sched_getaffinity(0))
RELAY_CORE, LOAD_CORE = _CORES[0], _CORES[-1]

BEFORE_OTHERS = 1
"""The least SCHED_FIFO priority. The load and all relays alike have it, where it is granted, so
that what else the machine does stays out of their comparison."""


@contextmanager
def on_core(core: int) -> Iterator[None]:
    """Keep the calling thread, and processes that it starts meanwhile, on one core."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {core})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


@contextmanager
def scheduled(priority: int) -> Iterator[bool]:
    """SCHED_FIFO for the calling thread and processes that it starts meanwhile, if granted.

    Args:
        priority: the priority; :data:`BEFORE_OTHERS` is enough to work undisturbed.

    Yields:
        Whether it was granted.
    """
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError:
        yield False
        return
    try:
        yield True
    finally:
        os.sched_setscheduler(0, policy, parameters)
