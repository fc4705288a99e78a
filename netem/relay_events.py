"""The events of a relay: one per datagram that arrives or departs."""

from noack.core.core_library import dtype_of

EVENT = dtype_of("noack_event")
"""One event, with the fields of ``noack_event`` in native/noack.h; the payload is ``data[offset :
offset + size_bytes]``."""
ADDRESS_BYTES = EVENT["source"].shape[0]
