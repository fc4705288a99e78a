"""The memory that Python and the pump share."""

import platform
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

NAME_BYTES = 32
"""Room for a socket address; those of IPv6 have 28 bytes."""
BLOCK_BYTES = 512
"""What is delayed is kept in chained blocks."""
CHUNK_BLOCKS = 4096
"""Blocks are allocated by so many."""
MOST_BYTES = 65_536
"""Nothing that is received is longer."""
SLOT_STRIDE = MOST_BYTES + 256
"""Receive buffers are so far apart that their beginnings do not share the cache's sets."""
READY_WORDS = 3 if platform.machine() in ("x86_64", "AMD64") else 4
"""32-bit words in struct epoll_event, which is packed on one architecture only."""

HOUSEKEEPING = 0
"""Why the pump returned: it is time."""
NEW_CLIENT = 1
"""The datagram at hand is from a new client."""
STORE_FULL = 2
"""There is no room to delay the datagram at hand."""
EVENTS_FULL = 3
"""Taps have to take what there is."""
LEAVING_FULL = 4
"""Within the pump: what leaves must be sent."""
CARRY_ON = 5
"""Within the pump."""

NO_NAME = 0
"""Where a direction's datagrams go: to what their socket is connected to."""
SERVER_NAME = 1
"""To the server, from a socket that is not connected."""
CLIENT_NAME = 2

PUMP = np.dtype(
    [
        ("epoll", "<i8"),
        ("epoch_ns", "<i8"),  # the monotonic clock at the relay's start
        ("unix_ns", "<i8"),  # Unix time at the relay's start
        # Times are since the relay's start, and these two never go back.
        ("now_ns", "<i8"),  # when the datagram at hand came, or what is let out was due
        ("read_ns", "<i8"),  # the last reading of the clock
        ("real_ns", "<i8"),  # what to add for the real-time clock
        ("stamps", "<i8"),  # 1: the kernel says when a datagram came
        ("arrival_ns", "<i8"),  # of what lies in the receive buffer at hand
        ("first_path", "<i8"),  # where the clients' return paths begin among the sockets
        ("buffers", "<i8"),  # address of the receive buffers
        ("slots_in", "<i8"),  # how many there are
        ("batch_socket", "<i8"),
        ("batch_next", "<i8"),  # the receive buffer at hand
        ("batch_end", "<i8"),
        ("ready", "<i8"),  # sockets that are ready
        ("ready_next", "<i8"),
        ("stamp", "<i8"),
        ("leaving", "<i8"),
        ("leaving_bytes", "<i8"),
        ("heap", "<i8"),
        ("put", "<i8"),  # datagrams that have been put under way
        ("free_slot", "<i8"),
        ("free_slots", "<i8"),
        ("free_block", "<i8"),
        ("free_blocks", "<i8"),
        ("no_memory", "<i8"),  # 1: there is none for more of these
        ("taps", "<i8"),  # 0: none, 1: without data, 2: with data
        ("events", "<i8"),
        ("data", "<i8"),
        ("segment", "<i8"),  # 1: let datagrams of equal size leave as one message
        ("segment_below", "<i8"),  # the kernel refuses to segment what is as long
        ("control_bytes", "<i8"),  # room for control messages of what is received, 0: none
        ("sleeps", "<i8"),  # 0: by epoll_pwait2, 1: by ppoll and epoll_wait
        ("spin_ns", "<i8"),  # it does not sleep for so long before something is due
    ]
)
SOCKET = np.dtype(
    [("fd", "<i4"), ("error", "<i4"), ("head", "<i4"), ("tail", "<i4"), ("stamp", "<i8")]
)
"""Sockets: those that the links listen on; those that they send from, if they take no answers; the
clients' return paths. ``error`` says why there is none, if fd is −1."""
CLIENT = np.dtype(
    [
        ("key0", "<i8"),
        ("key1", "<i8"),
        ("key2", "<i8"),
        ("key3", "<i8"),
        ("last_ns", "<i8"),  # when it, or the server, last sent
        ("number", "<i8"),  # of its flows; -1: there is none
        ("in_flight", "<i4"),
        ("link", "<i4"),
        ("place", "<i4"),  # row of its flows in the link's states
        ("name_bytes", "<i4"),
        ("name", "u1", (NAME_BYTES,)),
        ("local", "u1", (NAME_BYTES,)),  # address of its return path
    ]
)
TABLES = ("stages", "integers", "reals", "decisions", "decisions_begin")
STATES = ("flows", "memory", "recent_ns", "queues", "departures_ns")
DIRECTION = np.dtype(
    [
        *((name, "<i8") for name in TABLES),
        *((f"{name}_rows", "<i8") for name in TABLES),
        *((name, "<i8") for name in STATES),
        ("rows", "<i8"),
        ("width", "<i8"),  # of recent_ns
        ("departure_rows", "<i8"),
        ("mansd", "<i8"),
        ("limit", "<i8"),
        ("tracks", "<i8"),
        ("keeps", "<i8"),  # 1: what it lets out may have to be kept
        ("sends", "<i8"),  # NO_NAME, SERVER_NAME or CLIENT_NAME
        ("name_bytes", "<i8"),
        ("name", "u1", (NAME_BYTES,)),  # forward: the server's
        ("listen", "u1", (NAME_BYTES,)),  # the link's address
        ("full", "<i8"),  # forward: no more clients are taken
        ("refused", "<i8"),
        ("port_unreachable", "<i8"),  # forward: so often did ICMP say that nobody listens
    ]
)
"""One direction of a link: addresses and lengths of its program's tables and its state."""
LEAVING = np.dtype(
    [
        ("address", "<i8"),
        ("packet", "<i8"),
        ("arrival_ns", "<i8"),
        ("release_ns", "<i8"),
        ("bit", "<i8"),
        ("size_bytes", "<i4"),
        ("slot", "<i4"),  # where it was kept, -1: it is in a receive buffer
        ("socket", "<i4"),
        ("direction", "<i4"),
        ("client", "<i4"),
        ("next", "<i4"),
        ("error", "<i4"),
        ("delayed", "u1"),
        ("copy", "u1"),
        ("fate", "u1"),
        ("stale", "u1"),
        ("counts", "u1"),  # it is the first intact copy
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
        ("block", "<i4"),  # the first
        ("direction", "<i4"),
        ("client", "<i4"),
        ("next", "<i4"),  # of the free ones
        ("copy", "u1"),
        ("counts", "u1"),
        ("fate", "u1"),
        ("unused", "u1"),
    ]
)
"""A datagram that is kept."""
ENTRY = np.dtype([("release_ns", "<i8"), ("number", "<i8"), ("slot", "<i8")])
"""A datagram in the heap of those that are delayed."""
HEADER = np.dtype(
    [
        ("name", "<i8"), ("name_bytes", "<u4"), ("pad0", "<u4"), ("vectors", "<i8"),
        ("n_vectors", "<i8"), ("control", "<i8"), ("control_bytes", "<i8"), ("flags", "<i4"),
        ("pad1", "<u4"), ("size_bytes", "<i4"), ("pad2", "<u4"),
    ]
)  # fmt: skip
"""struct mmsghdr of 64-bit Linux."""
VECTOR = np.dtype([("base", "<i8"), ("size_bytes", "<i8")])
"""struct iovec."""
CONTROL_BYTES = 64
"""Room for the control messages of what is received."""
ERROR_CONTROL_BYTES = 128
"""Room for those of an error: a timestamp, the error, and the address of who reports it."""
CONTROL = np.dtype(
    [("bytes", "<i8"), ("level", "<i4"), ("kind", "<i4"), ("size_bytes", "<i4"), ("pad", "<i4")]
)
"""struct cmsghdr with the size of a segment."""

Array = NDArray[Any]


class Memory(NamedTuple):
    """All of it; one row each of the types above, unless said otherwise."""

    pump: Array
    """(1,)"""
    sockets: Array
    clients: Array
    table: Array
    """(power of 2,) int32: rows of clients by the hash of their address, −1 for none."""
    directions: Array
    """(2 · links,) The way forward and the way back of each link in turn."""
    link_states: Array
    """(2 · links,) :class:`noack.impairments.link_records.LinkState`."""
    counters: Array
    """(2 · links,) :class:`noack.impairments.link_records.Counters`."""
    delays: Array
    """(2 · links, BUCKETS) Histograms."""
    lateness: Array
    errors: Array
    """(2 · links, 256) Datagrams that could not be sent, or kept until then, by errno."""
    time: Array
    """(2,) int64: struct timespec."""
    poll: Array
    """(2,) int32: struct pollfd."""
    ready: Array
    """(k · READY_WORDS,) uint32: struct epoll_event."""
    in_headers: Array
    in_vectors: Array
    in_names: Array
    """(slots_in, 4) int64: socket addresses."""
    in_controls: Array
    """(slots_in, CONTROL_BYTES / 8) int64."""
    error_headers: Array
    error_controls: Array
    """(error_headers, k) int64."""
    out_headers: Array
    out_first: Array
    """(out_headers,) int32: the first datagram of each."""
    out_vectors: Array
    out_controls: Array
    leaving: Array
    order: Array
    """(leaving,) int32: the sockets that send."""
    heap: Array
    slots: Array
    chunks: Array
    """(k,) int64: addresses of chunks of blocks."""
    block_next: Array
    """(k · CHUNK_BLOCKS,) int32."""
    events: Array
    data: Array
    """(k,) uint8."""
    integers: Array
    """(1,) int32; only its type counts."""
