"""Locking a process's memory, so that its loop does not wait for a page.

All mappings are locked. Those of up to 16 MiB with code or with data that the process may write
are loaded beforehand. The larger ones are mostly unused: buffers of BLAS (32 MiB each), of which
the loop uses some pages. These are locked when they are first used, as are constants of libraries.

What this process shares with the fork server is not copied beforehand: a page of it is in memory,
and the loop writes to few of them, each of which then takes a microsecond. Nor are the stacks of
other threads (2 MiB each) loaded, most of which is never used.
"""

import ctypes
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_MADV_POPULATE_READ, _MADV_POPULATE_WRITE = 22, 23
_LARGE_BYTES = 16 * 2**20
_MAPPINGS = Path("/proc/self/smaps")
_MAPPING = re.compile(
    r"^([0-9a-f]+)-([0-9a-f]+) (...)(?s:.*?)^Shared_Dirty: +([0-9]+)", re.MULTILINE
)


def lock_memory() -> None:
    """Lock the memory of this process, now and in the future.

    Raises:
        OSError: it is not permitted.
    """
    if sys.platform != "linux":
        raise OSError(0, "not available on this system")
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    for mapping in _mappings():
        if mapping.bytes <= _LARGE_BYTES:
            # Fails for special mappings, and before Linux 5.14: then each page is locked at its use
            libc.madvise(
                ctypes.c_void_p(mapping.first), ctypes.c_size_t(mapping.bytes), mapping.advice
            )


class _Mapping(NamedTuple):
    """Memory of this process that is loaded."""

    first: int
    bytes: int
    advice: int


def _mappings() -> Iterator[_Mapping]:
    """Yield the code, and what this process alone may write."""
    guard_end = 0
    for found in _MAPPING.finditer(_MAPPINGS.read_text()):
        first, end, rights = int(found[1], 16), int(found[2], 16), found[3]
        is_stack = guard_end == first
        if rights == "---":  # a thread's stack begins with such a guard
            guard_end = end
        elif rights[2] == "x":
            yield _Mapping(first, end - first, _MADV_POPULATE_READ)
        elif rights[1] == "w" and not is_stack and found[4] == "0":
            yield _Mapping(first, end - first, _MADV_POPULATE_WRITE)
