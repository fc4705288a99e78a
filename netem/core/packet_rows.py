"""The rows that a channel or a relay of the core writes: each packet's outcome, and each departure."""

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from netem.core.core_library import dtype_of

NETEM_PACKET = "netem_packet"
"""Name of the table with a row for each packet that arrived."""
NETEM_RELEASE = "netem_release"
"""Name of the table with a row for each delayed packet, or copy, that left."""
PACKET_HEAD_BYTES = 32
"""Leading bytes of each datagram that the network emulator records without interpreting them."""
PACKET_ROW = np.dtype(
    [
        *((name, "<i8") for name in dtype_of("noack_packet_row").names[:-1]),  # type: ignore[index]
        ("head", f"V{PACKET_HEAD_BYTES}"),
    ]
)
"""A row of the first table."""


class Fate(IntEnum):
    """The network emulator's treatment of a datagram."""

    DELIVERED = 0
    DROPPED = 1
    FORCED = 2
    """Delivered by the guarantee, although an impairment would have prevented it."""
    CORRUPTED = 3
    """Forwarded with a flipped bit."""
    OVERFLOWED = 4
    """Dropped by a queue, full or by the law of CoDel; by a schedule; or by the limit of delayed packets."""
    BLACKED_OUT = 5
    """Dropped during a blackout."""

    @property
    def effective(self) -> bool:
        """Whether the datagram was effectively delivered, unless it is out of order (stale)."""
        return self in (Fate.DELIVERED, Fate.FORCED)


def effective(fates: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Whether each datagram was effectively delivered, unless it is out of order (stale), (k,)."""
    return np.asarray((fates == Fate.DELIVERED) | (fates == Fate.FORCED))
