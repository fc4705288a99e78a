"""Checks for memory for more delayed datagrams: a process's memory may be limited."""

import numpy as np

_HEADROOM_BYTES = 48 * 1024 * 1024
"""Reserve for everything but delayed datagrams. malloc serves blocks of this size from the system,
not from its heap, and returns them to the system when they are freed."""


def has_headroom(wanted_bytes: int = 0) -> bool:
    """Whether ``wanted_bytes`` and the headroom can be allocated; the check takes microseconds."""
    try:
        np.empty(_HEADROOM_BYTES + wanted_bytes, np.uint8)
    except MemoryError:
        return False
    return True
