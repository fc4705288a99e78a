"""Addresses as text: ``host:port``, ``[::1]:9000``, ``:9000``; and as the kernel has them."""

import re
import socket
import struct

from netem.core.errors import CallerError

Address = tuple[str, int]  # numeric host and port
SocketName = tuple[str, int] | tuple[str, int, int, int]
"""An address in the form that sockets use: host and port; IPv6: also flow label and scope."""
NAME_BYTES = 40  # room for a packed name (IPv6: 28 bytes), or for a flow through devices

LOOPBACK = "127.0.0.1"

_FORM = re.compile(r"(?:\[(?P<six>[^\[\]]+)\]|(?P<host>[^\[\]:]*)):(?P<port>[0-9]{1,5})")


def parse_address(text: str, setting: str, like: Address | None = None) -> Address:
    """Parse an address such as ``127.0.0.1:9000``, ``[::1]:9000``, ``localhost:9000`` or ``:9000``.

    Without a host it is the loopback, of the address family of ``like`` (by default IPv4). Raise
    CallerError if it has another form, or the host does not exist; ``setting`` is in the message.
    """
    match = _FORM.fullmatch(text)
    if match is not None and int(match["port"]) > 65_535:
        raise CallerError(f"{setting}: expected a port up to 65535; found {text!r}")
    if match is None:
        hint = "; put an IPv6 address in brackets" if text.count(":") > 1 else ""
        raise CallerError(
            f"{setting}: expected HOST:PORT, e.g. 127.0.0.1:9000, [::1]:9000 or :9000; found {text!r}{hint}"
        )
    family = socket.AF_INET if like is None else family_of(like)
    host = match["six"] or match["host"] or ("::1" if family == socket.AF_INET6 else LOOPBACK)
    family_hint = socket.AF_INET6 if match["six"] else socket.AF_UNSPEC
    try:
        entries = socket.getaddrinfo(host, int(match["port"]), family_hint, socket.SOCK_DGRAM)
    except (OSError, UnicodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a host name"
        raise CallerError(f"{setting}: {host}: no such host ({reason})") from None
    best = min(entries, key=lambda entry: entry[0] != family)
    host, port, *extra = best[4]
    scope = extra[1] if extra else 0
    return (f"{host}%{scope}" if scope else str(host)), int(port)


def parse_destination(text: str, setting: str, like: Address | None = None) -> Address:
    """As :func:`parse_address`, for an address to which datagrams are sent: port 0 is refused."""
    address = parse_address(text, setting, like)
    if address[1] == 0:
        raise CallerError(f"{setting}: expected a port from 1 to 65535; found {text!r}")
    return address


def address_text(address: Address) -> str:
    """``host:port``, with an IPv6 address in brackets."""
    host, port = address[:2]
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def family_of(address: Address) -> int:
    """``AF_INET6`` or ``AF_INET``."""
    return socket.AF_INET6 if ":" in address[0] else socket.AF_INET


def packed_name(name: SocketName) -> tuple[bytes, int]:
    """Return a name as the kernel's struct sockaddr, padded to NAME_BYTES, and its length."""
    host, port, flow, scope = (*name, 0, 0)[:4]
    host, _, interface = host.partition("%")
    if ":" not in host:
        packed = struct.pack("=H", socket.AF_INET) + struct.pack("!H", port)
        packed += socket.inet_pton(socket.AF_INET, host) + bytes(8)
    else:
        if interface and not scope:
            scope = int(interface) if interface.isdecimal() else socket.if_nametoindex(interface)
        packed = struct.pack("=H", socket.AF_INET6) + struct.pack("!HI", port, flow)
        packed += socket.inet_pton(socket.AF_INET6, host) + struct.pack("=I", scope)
    return packed.ljust(NAME_BYTES, b"\0"), len(packed)


def address_of(name: SocketName) -> Address:
    """Return a name from ``getsockname`` as an address; a scope follows the host after ``%``."""
    host, scope = str(name[0]).partition("%")[0], name[3] if len(name) > 3 else 0
    return (f"{host}%{scope}" if scope else host), int(name[1])


def unpacked_address(packed: bytes) -> Address:
    """Return a struct sockaddr as host and port; a scope follows the host after ``%``."""
    (family,) = struct.unpack_from("=H", packed)
    (port,) = struct.unpack_from("!H", packed, 2)
    if family == socket.AF_INET:
        return socket.inet_ntop(socket.AF_INET, packed[4:8]), port
    (scope,) = struct.unpack_from("=I", packed, 24)
    return address_of((socket.inet_ntop(socket.AF_INET6, packed[8:24]), port, 0, scope))
