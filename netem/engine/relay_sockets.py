"""A relay's sockets, over IPv4 and IPv6."""

import ctypes
import errno
import socket
import struct
import sys
from collections.abc import Sequence
from contextlib import suppress
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import Any, NamedTuple

from netem.engine.relay_interface import Address, LinkSpec
from noack.core.errors import CallerError
from noack.runtime.address import text_of
from noack.runtime.udp_sockets import enlarge_buffer

_BUFFER_BYTES = 4 * 1024 * 1024
_SO_SNDBUFFORCE = 32
_SO_ATTACH_FILTER = 26
_BPF_RETURN = 6
_SO_TIMESTAMPNS = 35
_MSG_ERRQUEUE = 0x2000
_EXTENDED_ERROR = struct.Struct("=IB")
"""Start of struct sock_extended_err: errno and origin."""
_ICMP_ORIGINS = (2, 3)
_RECVERR = ((socket.IPPROTO_IP, 11), (socket.IPPROTO_IPV6, 25))
"""Levels and options: IP_RECVERR, IPV6_RECVERR."""
_ERROR_BYTES = 128

Endpoint = socket.socket


class ListenAddress(NamedTuple):
    """An address to which datagrams can be sent: a family, and the address in its sockets' form."""

    family: int
    address: Any


def place_of(address: Address, what: str) -> ListenAddress:
    """Return an address in the form that sockets use.

    Raises:
        CallerError: the host is not numeric.
    """
    host, port = address
    try:
        found = socket.getaddrinfo(
            host, port, type=socket.SOCK_DGRAM, flags=socket.AI_NUMERICHOST | socket.AI_NUMERICSERV
        )
    except OSError as error:
        raise CallerError(
            f"{what}: {host}: not an address of IPv4 or IPv6 ({error.strerror})"
        ) from None
    return ListenAddress(int(found[0][0]), found[0][4])


def listen(spec: LinkSpec, place: ListenAddress) -> Endpoint:
    """Return the socket that a link listens on.

    Raises:
        CallerError: the address cannot be bound.
    """
    endpoint = socket.socket(place.family, socket.SOCK_DGRAM)
    try:
        endpoint.bind(place.address)
    except OSError as error:
        endpoint.close()
        reason = {
            errno.EADDRINUSE: "is already taken by another program",
            errno.EACCES: "needs privileges that this user does not have",
            errno.EADDRNOTAVAIL: "is no address of this machine",
        }.get(error.errno or 0, f"cannot be bound ({error.strerror})")
        raise CallerError(
            f"link {spec.name}: UDP port {text_of(spec.listen)} {reason}; "
            "listen on another, or on port 0 for any"
        ) from None
    _prepare(endpoint)
    return endpoint


def return_path(server: ListenAddress) -> Endpoint:
    """Return a socket connected to the server; it receives the server's answers only.

    Raises:
        OSError: there is no route to the server, or no file descriptor left.
    """
    endpoint = socket.socket(server.family, socket.SOCK_DGRAM)
    try:
        endpoint.connect(server.address)
        _prepare(endpoint)
    except BaseException:
        endpoint.close()
        raise
    return endpoint


def one_way_path(server: ListenAddress) -> Endpoint:
    """Return the sending socket of a link without a reverse direction.

    It receives nothing: the kernel drops answers at once; they are counted by
    :func:`noack.runtime.udp_sockets.drops_of`.

    Raises:
        OSError: there is no file descriptor left.
    """
    endpoint = socket.socket(server.family, socket.SOCK_DGRAM)
    try:
        _take_nothing(endpoint)
        # Bind to the address that it will send from, if there is a route to the server.
        with suppress(OSError), socket.socket(server.family, socket.SOCK_DGRAM) as scout:
            scout.connect(server.address)
            endpoint.bind((scout.getsockname()[0], 0, *scout.getsockname()[2:]))
        if endpoint.getsockname()[1] == 0:
            endpoint.bind(("", 0))
        endpoint.setblocking(False)
        _prepare_to_send(endpoint)
    except BaseException:
        endpoint.close()
        raise
    return endpoint


def leads_to(server: ListenAddress, here: ListenAddress) -> bool:
    """Whether datagrams to the host of ``server`` reach a socket bound to ``here`` (any port).

    The system resolves source and destination, so that this machine's addresses are recognised,
    and the unspecified address is the loopback address.
    """
    try:
        with socket.socket(server.family, socket.SOCK_DGRAM) as probe:
            probe.connect(server.address)
            source, host = (_host(name) for name in (probe.getsockname(), probe.getpeername()))
    except OSError:
        return False
    bound = _host(here.address)
    if bound.is_unspecified:
        return (host == source or host.is_loopback) and bound.version >= host.version
    return bound == host


def stamp_arrivals(endpoint: Endpoint) -> None:
    """Enable kernel timestamps of arrival, if the system supports them."""
    with suppress(OSError):
        endpoint.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)


def icmp_errors(endpoint: Endpoint) -> list[int]:
    """Empty a socket's error queue; return the errno of each ICMP error.

    The compiled engine has its own version (:mod:`netem.engine.pump.error_queue`).
    """
    found: list[int] = []
    with suppress(OSError):
        while sys.platform == "linux":
            _, ancillary, _, _ = endpoint.recvmsg(0, _ERROR_BYTES, _MSG_ERRQUEUE)
            for level, kind, data in ancillary:
                if (level, kind) in _RECVERR and len(data) >= _EXTENDED_ERROR.size:
                    error, origin = _EXTENDED_ERROR.unpack_from(data)
                    found += [error] if origin in _ICMP_ORIGINS else []
    return found


def has_data(endpoint: Endpoint) -> bool:
    """Whether a received datagram waits at the socket."""
    try:
        endpoint.recv(1, socket.MSG_PEEK)
    except OSError:
        return False
    return True


def raise_file_limit() -> None:
    """Raise this process's limit of open files to the hard limit."""
    with suppress(ImportError, OSError, ValueError):
        import resource

        _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


def address_of(name: Sequence[Any]) -> Address:
    """Return a name from ``getsockname`` as an address; a scope follows the host after ``%``."""
    host, scope = str(name[0]).partition("%")[0], name[3] if len(name) > 3 else 0
    return (f"{host}%{scope}" if scope else host), int(name[1])


def _host(name: Sequence[Any]) -> IPv4Address | IPv6Address:
    host, _ = address_of(name)
    return ip_address(host)


def _prepare(endpoint: Endpoint) -> None:
    endpoint.setblocking(False)
    enlarge_buffer(endpoint)
    _prepare_to_send(endpoint)


def _prepare_to_send(endpoint: Endpoint) -> None:
    """Enlarge the send buffer; on Linux, make a send to a full device queue fail (ENOBUFS).

    Without IP_RECVERR, Linux drops such datagrams silently. With it, the socket's error queue must
    be emptied.
    """
    if sys.platform == "linux":
        for level, option in _RECVERR:
            with suppress(OSError):  # not an IPv6 socket
                endpoint.setsockopt(level, option, 1)
    try:
        endpoint.setsockopt(socket.SOL_SOCKET, _SO_SNDBUFFORCE, _BUFFER_BYTES)
    except OSError:
        with suppress(OSError):
            endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)


def _take_nothing(endpoint: Endpoint) -> None:
    """Make the kernel drop received datagrams: by a filter, or else by a minimal buffer."""
    instruction = ctypes.create_string_buffer(struct.pack("=HBBI", _BPF_RETURN, 0, 0, 0))
    program = struct.pack("@HP", 1, ctypes.addressof(instruction))
    with suppress(OSError):
        endpoint.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, program)
    with suppress(OSError):
        endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)
