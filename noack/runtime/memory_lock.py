"""Locking a process's memory, so that its loop does not wait for a page.

All mappings are locked, but only those of up to 16 MiB are loaded beforehand. The larger ones are
mostly unused: buffers of BLAS (32 MiB each) and the compiler's library (150 MiB), of which the loop
uses some pages. These are locked when they are first used.
"""

import ctypes
import os
import sys
from pathlib import Path

_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_MADV_POPULATE_READ, _MADV_POPULATE_WRITE = 22, 23
_LARGE_BYTES = 16 * 2**20
_MAPS = Path("/proc/self/maps")


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
    for mapping in _MAPS.read_text().splitlines():
        place, permissions = mapping.split(maxsplit=2)[:2]
        first, end = (int(address, 16) for address in place.split("-"))
        if permissions[0] == "r" and end - first <= _LARGE_BYTES:
            advice = _MADV_POPULATE_WRITE if permissions[1] == "w" else _MADV_POPULATE_READ
            # Fails for special mappings, and before Linux 5.14: then each page is locked at its use
            libc.madvise(ctypes.c_void_p(first), ctypes.c_size_t(end - first), advice)
