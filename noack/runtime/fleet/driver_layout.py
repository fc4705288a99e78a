"""The memory that Python and the compiled driver of a fleet share."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.config.fleet_layout import FleetMemory

Array = NDArray[Any]

# Why the driver returned.
HOUSEKEEPING = 0  # the time for housekeeping has come
ROWS_FULL = 1  # a buffer of rows or notes must be emptied
MATRIX_MISSING = 2  # a transition matrix must be computed

BUFFERS = 64
"""Datagrams that are received or sent at once."""
AT_ONCE = 32
"""Timers that are served before the next look at the socket."""

WIRE = np.dtype(
    [
        (name, "<i8")
        for name in (
            "sends",  # first word of each datagram sent, without the loop
            "run_id",
            "entries_sent",
            "flow_received",
            "entries_received",
        )
    ]
)
DRIVER = np.dtype(
    [("speed", "<f8")]
    + [
        (name, "<i8")
        for name in (
            "fd_in",
            "fd_out",
            "epoch_ns",  # the monotonic clock at the start of the run
            "rest_ns",  # wall time between two turns with work, so that several do theirs at once
            "arrived_next",  # the current datagram
            "arrived_end",
            "from_peer",  # 1: the current datagrams come from the peer
            "due",  # loops with a deadline
            "prefix_bytes",  # 2: a row begins with the number of the loop; 0: it does not
            "timer_row_bytes",
            "timer_rows",
            "message_row_bytes",
            "message_rows",
            "sent",
        )
    ]
)


class WireMemory(NamedTuple):
    """What is needed to read and write datagrams."""

    settings: Array
    """(1,) :data:`WIRE`."""
    keyed: Array
    """(8,) uint64: BLAKE2b's state after the run's key."""
    chain: Array
    """(8,) uint64"""
    block: Array
    """(16,) uint64"""


class DriverMemory(NamedTuple):
    """All arrays but those of the role."""

    fleet: FleetMemory
    wire: WireMemory
    driver: Array
    """(1,) :data:`DRIVER`."""
    heap: Array
    """(2L,) int64: deadlines in the time of the run with their loops, a heap."""
    timer_rows: Array
    """(k,) uint8: rows of the table of :func:`on_timer`."""
    message_rows: Array
    """(k,) uint8: rows of the table of :func:`handle`."""
    rejected: Array
    """(L, reasons) int64: rejected datagrams; those without a loop count for the first."""
    errors: Array
    """(256,) int64: datagrams that could not be sent, by errno."""
    headers_in: Array
    vectors_in: Array
    headers_out: Array
    vectors_out: Array
    time: Array
    """(2,) int64: struct timespec."""
    poll: Array
    """(2,) int32: struct pollfd."""
    integers: Array
    """(1,) int32; only its type matters."""
    data: Array
    """(2,) uint16: the number of a loop."""
