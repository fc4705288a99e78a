"""Cores and priorities of the load and the relays."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

_CORES = sorted(os.sched_getaffinity(0))
RELAY_CORE, LOAD_CORE = _CORES[0], _CORES[-1]

BEFORE_OTHERS = 1
"""The lowest SCHED_FIFO priority. If permitted, the load and all relays have it, so that other
programs of the machine do not affect their comparison."""


@contextmanager
def on_core(core: int) -> Iterator[None]:
    """Pin the calling thread, and processes that it starts within the context, to one core."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {core})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


@contextmanager
def scheduled(priority: int) -> Iterator[bool]:
    """Apply SCHED_FIFO to the calling thread and the processes that it starts, if permitted.

    Args:
        priority: the priority; :data:`BEFORE_OTHERS` is enough to work undisturbed.

    Yields:
        Whether it was permitted.
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
