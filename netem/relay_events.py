"""The events of a relay: one per datagram that arrives or departs."""

import numpy as np

ADDRESS_BYTES = 16

EVENT = np.dtype(
    [
        ("t_ns", "<i8"),  # Unix time
        ("flow", "<i8"),  # number of the flow within the link
        ("packet", "<i8"),  # number of the datagram within its flow
        (
            "consecutive_losses",
            "<i8",
        ),  # arrival: consecutive losses up to and including this datagram
        ("mansd", "<i8"),  # the cap on consecutive losses (M - 1), -1 none
        ("delay_ns", "<i8"),  # arrival: decided delay, -1 never leaves; departure: actual delay
        ("copy_delay_ns", "<i8"),  # arrival: decided delay of its copy, -1 no copy
        ("hold_back_ns", "<i8"),  # arrival: time held back for the guarantee
        ("bit", "<i8"),  # the corrupted bit of the payload, -1 none
        ("copy_bit", "<i8"),  # arrival: the corrupted bit of its copy, -1 none
        ("offset", "<u8"),  # place of the payload in the batch's data, if a tap needs data
        ("size_bytes", "<u4"),  # of the payload
        ("link", "<u4"),  # number of the link
        ("interface", "<u4"),  # 2·link is the link's client side, 2·link + 1 the server side
        ("source_port", "<u2"),
        ("destination_port", "<u2"),
        ("source", "u1", (ADDRESS_BYTES,)),  # an IPv4 address is in the first 4 bytes
        ("destination", "u1", (ADDRESS_BYTES,)),
        ("family", "u1"),  # 4 or 6, the version of IP
        ("departure", "u1"),  # 0: a datagram arrived here, 1: it or its copy departed here
        ("direction", "u1"),  # 0 forward, from client to server; 1 reverse
        ("fate", "u1"),  # noack.protocol.record_tables.Fate
        ("copy", "u1"),  # departure: 1 is the duplicate
        ("stale", "u1"),  # departure: a newer datagram of the flow had left before
        ("unused", "u1", (2,)),
    ]
)
"""One event; the payload is ``data[offset : offset + size_bytes]``."""
