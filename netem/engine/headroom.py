"""Whether there is memory for more datagrams that are delayed, as a process may be limited."""

import numpy as np

_HEADROOM_BYTES = 48 * 1024 * 1024
"""For all that is not delayed datagrams. More than malloc ever serves from its heap, so that it is
asked of the system, and given back at once."""


def has_headroom(wanted_bytes: int = 0) -> bool:
    """Whether the system would give so much memory, and the headroom; it takes microseconds."""
    try:
        np.empty(_HEADROOM_BYTES + wanted_bytes, np.uint8)
    except MemoryError:
        return False
    return True
