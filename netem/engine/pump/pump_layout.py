"""The memory that Python and the pump share."""

import platform
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.protocol.record_tables import PACKET_HEAD_BYTES
from noack.runtime.native.socket_structs import HEADER as HEADER
from noack.runtime.native.socket_structs import NAME_BYTES as NAME_BYTES
from noack.runtime.native.socket_structs import VECTOR as VECTOR

BLOCK_BYTES = 512  # payloads of delayed datagrams are kept in chained blocks of this size
CHUNK_BLOCKS = 4096  # number of blocks per allocation
MOST_BYTES = 65_536  # no received datagram is longer
SLOT_STRIDE = MOST_BYTES + 256
"""Distance of receive buffers: their first bytes are in different cache sets."""
SYS_EPOLL_PWAIT2 = 441  # on every architecture; libc has the function since glibc 2.35
_ON_X86 = platform.machine() in ("x86_64", "AMD64")
SYS_SENDTO = 44 if _ON_X86 else 206
READY_WORDS = 3 if _ON_X86 else 4
"""32-bit words in struct epoll_event, which is packed on x86-64 only."""

# Why the pump returned; LEAVING_FULL and CARRY_ON occur within the pump only.
HOUSEKEEPING = 0  # the time for housekeeping has come
NEW_CLIENT = 1  # the current datagram is from a new client
STORE_FULL = 2  # there is no room to store the current datagram
EVENTS_FULL = 3  # a buffer of events or of record rows is full and must be emptied
LEAVING_FULL = 4  # the list of departures is full and must be sent
CARRY_ON = 5  # no reason to return
CHANGE_DUE = 6  # other settings apply from the current datagram on

# The socket that sends a direction's datagrams, and their destination.
OWN_SOCKET = 0  # the client's socket, which is connected to the destination
DESTINATION_NAME = 1  # the link's sending socket, which is not connected, to the destination
CLIENT_NAME = 2  # the link's listening socket, to the client
LINK_SOCKET = 3  # the link's sending socket, which is connected to the destination

PUMP = np.dtype(
    [
        ("epoll", "<i8"),
        ("epoch_ns", "<i8"),  # the monotonic clock at the relay's start
        ("unix_ns", "<i8"),  # Unix time at the relay's start
        ("speed", "<f8"),  # simulated time per time of the monotonic clock
        # Times are simulated and count from the relay's start; these two never decrease.
        ("now_ns", "<i8"),  # arrival of the current datagram, or its release time
        ("read_ns", "<i8"),  # the last reading of the clock
        ("real_ns", "<i8"),  # the real-time clock at the last receiving of datagrams
        ("stamps", "<i8"),  # 1: the kernel adds arrival timestamps
        ("arrival_ns", "<i8"),  # arrival of the datagram in the current receive buffer
        ("first_path", "<i8"),  # first row of the clients' return paths among the sockets
        ("buffers", "<i8"),  # address of the receive buffers
        ("slots_in", "<i8"),  # number of receive buffers
        ("batch_socket", "<i8"),
        ("batch_next", "<i8"),  # the current receive buffer
        ("batch_end", "<i8"),
        ("loaded", "<i8"),  # a sum of what was loaded into the caches, so that it is loaded
        ("ready", "<i8"),  # number of sockets that are ready
        ("ready_next", "<i8"),
        ("stamp", "<i8"),
        ("leaving", "<i8"),
        ("leaving_bytes", "<i8"),
        ("heap", "<i8"),
        ("put", "<i8"),  # datagrams that have been delayed so far
        ("free_slot", "<i8"),
        ("free_slots", "<i8"),
        ("free_block", "<i8"),
        ("free_blocks", "<i8"),
        ("no_memory", "<i8"),  # 1: no memory for more delayed datagrams
        ("taps", "<i8"),  # 0: none, 1: without data, 2: with data
        ("events", "<i8"),
        ("data", "<i8"),
        ("records", "<i8"),  # 1: write rows of the record
        ("inputs", "<i8"),  # number of the next row of the record
        ("first_number", "<i8"),  # number of the first packet in the record
        ("loops", "<i8"),  # of a run: number of its loops; the rows of their clients begin at 0
        ("by_loop", "<i8"),  # 1: a datagram has its loop's number in its header
        ("no_loop", "<i8"),  # datagrams refused because of this number
        ("packet_rows", "<i8"),  # rows written so far
        ("release_rows", "<i8"),
        ("change_ns", "<i8"),  # time from which other settings apply
        ("segment", "<i8"),  # 1: send datagrams of equal size as one message
        ("segment_below", "<i8"),  # the kernel does not segment datagrams of this size
        ("control_bytes", "<i8"),  # buffer for received control messages, 0: none
        ("sleeps", "<i8"),  # 0: by epoll_pwait2, 1: by ppoll and epoll_wait
        ("spin_ns", "<i8"),  # time before a departure in which the pump does not sleep
    ]
)
PACKET_ROW = np.dtype(
    [
        *((name, "<i8") for name in (
            "input", "sequence", "t_ns", "now_ns", "flow", "fate", "consecutive_losses",
            "release_ns", "copy_ns", "bit", "size_bytes",
        )),
        ("head", "u1", (PACKET_HEAD_BYTES,)),
    ]
)  # fmt: skip
"""A row of the record's table ``netem_packet``, byte for byte; numba has no type ``V``."""
RELEASE_ROW = np.dtype(
    [(name, "<i8") for name in ("input", "sequence", "t_ns", "now_ns", "flow", "copy", "stale")]
)
"""A row of the table ``netem_release``."""
SOCKET = np.dtype(
    [("fd", "<i4"), ("error", "<i4"), ("head", "<i4"), ("tail", "<i4"), ("stamp", "<i8")]
)
"""Sockets: the links' listening sockets; the sending sockets of links without a reverse direction;
the clients' return paths. If fd is −1, ``error`` is the errno of the failure to open it."""
CLIENT = np.dtype(
    [
        ("key0", "<i8"),
        ("key1", "<i8"),
        ("key2", "<i8"),
        ("key3", "<i8"),
        ("last_ns", "<i8"),  # last datagram of the client or of the destination
        ("number", "<i8"),  # number of its flows; -1: the row is free
        ("in_flight", "<i4"),
        ("link", "<i4"),
        ("place", "<i4"),  # row of its flows in the link's two states
        ("name_bytes", "<i4"),
        ("name", "u1", (NAME_BYTES,)),
        ("local", "u1", (NAME_BYTES,)),  # address of its return path
    ]
)
DIRECTION = np.dtype(
    [
        ("link", "<i8"),  # address of its ``noack_link``
        ("mansd", "<i8"),
        ("keeps", "<i8"),  # 1: datagrams can be delayed
        ("sends", "<i8"),  # OWN_SOCKET, DESTINATION_NAME, CLIENT_NAME or LINK_SOCKET
        ("name_bytes", "<i8"),
        ("name", "u1", (NAME_BYTES,)),  # forward: the server's
        ("listen", "u1", (NAME_BYTES,)),  # the link's address
        ("full", "<i8"),  # forward: 1: further clients are refused
        ("refused", "<i8"),
        ("port_unreachable", "<i8"),  # forward: ICMP port-unreachable errors
    ]
)
"""One direction of a link."""
LEAVING = np.dtype(
    [
        ("address", "<i8"),
        ("packet", "<i8"),
        ("arrival_ns", "<i8"),
        ("release_ns", "<i8"),
        ("bit", "<i8"),
        ("size_bytes", "<i4"),
        ("slot", "<i4"),  # slot of the payload, -1: it is in a receive buffer
        ("socket", "<i4"),
        ("direction", "<i4"),
        ("client", "<i4"),
        ("next", "<i4"),
        ("error", "<i4"),
        ("delayed", "u1"),
        ("copy", "u1"),
        ("fate", "u1"),
        ("stale", "u1"),
        ("counts", "u1"),  # 1: it is the first intact copy
        ("unused", "u1", (3,)),
    ]
)
"""A datagram that is about to be sent."""
SLOT = np.dtype(
    [
        ("packet", "<i8"),
        ("arrival_ns", "<i8"),
        ("bit", "<i8"),
        ("size_bytes", "<i4"),
        ("block", "<i4"),  # first block of the payload
        ("direction", "<i4"),
        ("client", "<i4"),
        ("next", "<i4"),  # next free slot
        ("copy", "u1"),
        ("counts", "u1"),
        ("fate", "u1"),
        ("unused", "u1"),
    ]
)
"""A stored datagram."""
ENTRY = np.dtype([("release_ns", "<i8"), ("number", "<i8"), ("slot", "<i8")])
"""An entry of the heap of delayed datagrams."""
CONTROL_BYTES = 64  # Buffer size for the control messages of a received datagram
ERROR_CONTROL_BYTES = 128
"""Buffer size for the control messages of an error: timestamp, error, address of the reporter."""
CONTROL = np.dtype(
    [("bytes", "<i8"), ("level", "<i4"), ("kind", "<i4"), ("size_bytes", "<i4"), ("pad", "<i4")]
)
"""struct cmsghdr with a segment size."""

Array = NDArray[Any]


class Memory(NamedTuple):
    """The arrays; each has rows of one of the types above, unless stated otherwise."""

    pump: Array  # (1,)
    sockets: Array
    clients: Array
    table: Array  # (power of 2,) int32: rows of clients by the hash of their address, -1 for none
    directions: Array  # (2 · links,) Forward and reverse direction of each link
    delays: Array  # (2 · links, BUCKETS) Histograms of the time from arrival to departure
    lateness: Array
    errors: Array  # (2 · links, 256) Number of datagrams that could not be sent or stored, by errno
    time: Array  # (2,) int64: struct timespec
    poll: Array  # (2,) int32: struct pollfd
    ready: Array  # (k · READY_WORDS,) uint32: struct epoll_event
    in_headers: Array
    in_vectors: Array
    in_names: Array  # (slots_in, 4) int64: socket addresses
    in_controls: Array  # (slots_in, CONTROL_BYTES / 8) int64
    error_headers: Array
    error_controls: Array  # (error_headers, k) int64
    out_headers: Array
    out_first: Array  # (out_headers,) int32: first datagram of each message
    out_vectors: Array
    out_controls: Array
    leaving: Array
    order: Array  # (leaving,) int32: the sockets that have something to send
    heap: Array
    slots: Array
    chunks: Array  # (k,) int64: addresses of chunks of blocks
    block_next: Array  # (k · CHUNK_BLOCKS,) int32
    events: Array
    data: Array  # (k,) uint8
    packets: Array  # rows of the record
    releases: Array
    integers: Array  # (1,) int32; only its type matters
