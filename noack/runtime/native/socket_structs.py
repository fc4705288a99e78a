"""Structures of the socket interface of 64-bit Linux."""

import socket
import struct
from typing import Any

import numpy as np

NAME_BYTES = 32  # room for a socket address; those of IPv6 have 28 bytes
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

SocketName = tuple[Any, ...]
"""An address in the form that sockets use: host and port; IPv6: also flow label and scope."""


def packed_name(name: SocketName) -> tuple[bytes, int]:
    """Return a name as the kernel's struct sockaddr, padded to NAME_BYTES, and its length."""
    host, port, flow, scope = (*name, 0, 0)[:4]
    if ":" not in host:
        packed = struct.pack("=H", socket.AF_INET) + struct.pack("!H", port)
        packed += socket.inet_pton(socket.AF_INET, host) + bytes(8)
    else:
        packed = struct.pack("=H", socket.AF_INET6) + struct.pack("!HI", port, flow)
        packed += socket.inet_pton(socket.AF_INET6, host.partition("%")[0])
        packed += struct.pack("=I", scope)
    return packed.ljust(NAME_BYTES, b"\0"), len(packed)
