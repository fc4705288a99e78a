"""The events of a relay: one per datagram that arrives or departs."""

import numpy as np
from numpy.typing import NDArray

from noack.core.core_library import dtype_of

Bytes = NDArray[np.uint8]
Events = NDArray[np.void]

EVENT = dtype_of("noack_event")
"""One event, with the fields of ``noack_event`` in native/noack.h; the payload is ``data[offset :
offset + size_bytes]``."""
