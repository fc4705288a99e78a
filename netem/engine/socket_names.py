"""Socket addresses in the kernel's format (struct sockaddr_in and sockaddr_in6)."""

import socket
import struct

from netem.engine.pump.pump_layout import NAME_BYTES
from netem.engine.relay_interface import Address
from netem.engine.relay_sockets import ListenAddress


def name_of(place: ListenAddress) -> tuple[bytes, int]:
    """Return an address as a socket address, padded to NAME_BYTES, and its length."""
    host, port = place.address[:2]
    head = struct.pack("=H", place.family) + struct.pack("!H", port)
    if place.family == socket.AF_INET:
        name = head + socket.inet_pton(socket.AF_INET, host) + bytes(8)
    else:
        _, _, flow, scope = place.address
        packed = socket.inet_pton(socket.AF_INET6, host.partition("%")[0])
        name = head + struct.pack("!I", flow) + packed + struct.pack("=I", scope)
    return name.ljust(NAME_BYTES, b"\0"), len(name)


def address_of_name(name: bytes) -> Address:
    """Return a socket address as host and port; a scope follows the host after ``%``."""
    (family,) = struct.unpack_from("=H", name)
    (port,) = struct.unpack_from("!H", name, 2)
    if family == socket.AF_INET:
        return socket.inet_ntop(socket.AF_INET, name[4:8]), port
    host = socket.inet_ntop(socket.AF_INET6, name[8:24])
    (scope,) = struct.unpack_from("=I", name, 24)
    return (f"{host}%{scope}" if scope else host), port
