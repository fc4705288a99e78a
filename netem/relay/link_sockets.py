"""The sockets of a relay's links, over IPv4 and IPv6."""

import ctypes
import errno
import socket
import struct
import sys
from contextlib import ExitStack, suppress
from ipaddress import IPv4Address, IPv6Address, ip_address

from netem.core.address import Address, SocketName, address_of
from netem.core.errors import CallerError
from netem.core.udp_sockets import bind_to, enlarge_buffer

_BUFFER_BYTES = 4 * 1024 * 1024
"""Send buffer of a socket."""
RECEIVE_WAIT_NS = 8_000_000
"""Much less than the time between two turns of housekeeping."""
_SO_SNDBUFFORCE = 32
_SO_ATTACH_FILTER = 26
_BPF_RETURN = 6
_SO_TIMESTAMPNS = 35
_RECVERR = ((socket.IPPROTO_IP, 11), (socket.IPPROTO_IPV6, 25))
"""Levels and options: IP_RECVERR, IPV6_RECVERR."""

Endpoint = socket.socket


def socket_name(address: Address, setting: str) -> SocketName:
    """Return an address in the form that sockets use.

    Raises:
        CallerError: the host is not numeric.
    """
    numeric = socket.AI_NUMERICHOST | socket.AI_NUMERICSERV
    try:
        results = socket.getaddrinfo(*address, type=socket.SOCK_DGRAM, flags=numeric)
    except OSError as error:
        raise CallerError(
            f"{setting}: {address[0]}: not an address of IPv4 or IPv6 ({error.strerror})"
        ) from None
    name = results[0][4]
    assert isinstance(name[0], str)
    return name


def _udp_socket(name: SocketName) -> Endpoint:
    family = socket.AF_INET if len(name) == 2 else socket.AF_INET6
    return socket.socket(family, socket.SOCK_DGRAM)


def listen(title: str, name: SocketName) -> Endpoint:
    """Return the socket that a link listens on; ``title`` names it in a message.

    Raises:
        CallerError: the address cannot be bound.
    """
    if ip_address(name[0].partition("%")[0]).is_multicast:
        raise CallerError(f"{title}: a multicast address; clients send to an address of this machine")
    if _is_broadcast(name):
        raise CallerError(f"{title}: a broadcast address; clients send to an address of this machine")
    endpoint = _udp_socket(name)
    bind_to(endpoint, name, title, "listen on another, or on port 0 for any")
    _prepare(endpoint)
    return endpoint


def _is_broadcast(name: SocketName) -> bool:
    """Return whether an address is that of all hosts of a network.

    The system knows the networks: it does not connect a socket to such an address without leave.
    """
    with _udp_socket(name) as probe:
        try:
            probe.connect((name[0], 9, *name[2:]))
        except OSError as error:
            return error.errno == errno.EACCES
    return False


def return_path(server: SocketName) -> tuple[Endpoint | None, int]:
    """Return a socket connected to the server, which receives the server's answers only, and 0.

    If there is no route to the server, or no file descriptor left: None and the errno.
    """
    with ExitStack() as undo:
        try:
            endpoint = undo.enter_context(_udp_socket(server))
            endpoint.connect(server)
        except OSError as error:
            return None, error.errno or errno.EIO
        _prepare(endpoint)
        undo.pop_all()
    return endpoint, 0


def one_way_path(server: SocketName) -> Endpoint:
    """Return the sending socket of a link without a reverse direction.

    It receives nothing: the kernel drops answers at once; they are counted by
    :func:`netem.core.udp_sockets.drops_of`.

    Raises:
        OSError: there is no file descriptor left.
    """
    with ExitStack() as undo:
        endpoint = undo.enter_context(_udp_socket(server))
        _drop_received(endpoint)
        # Bind to the address that it will send from, if there is a route to the server.
        with suppress(OSError), _udp_socket(server) as probe:
            probe.connect(server)
            endpoint.bind((probe.getsockname()[0], 0, *probe.getsockname()[2:]))
        if endpoint.getsockname()[1] == 0:
            endpoint.bind(("", 0))
        endpoint.setblocking(False)
        _prepare_to_send(endpoint)
        undo.pop_all()
    return endpoint


def leads_to(server: SocketName, bound_name: SocketName) -> bool:
    """Whether datagrams to the host of ``server`` reach a socket bound to a name (any port).

    The system resolves source and destination, so that this machine's addresses are recognised,
    and the unspecified address is the loopback address.
    """
    try:
        with _udp_socket(server) as probe:
            probe.connect(server)
            source, host = (_host(name) for name in (probe.getsockname(), probe.getpeername()))
    except OSError:
        return False
    bound = _host(bound_name)
    if bound.is_unspecified:
        return (host == source or host.is_loopback) and bound.version >= host.version
    return bound == host


def stamp_arrivals(endpoint: Endpoint) -> None:
    """Enable kernel timestamps of arrival, if the system supports them."""
    with suppress(OSError):
        endpoint.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)


def set_receive_timeout(endpoint: Endpoint) -> int:
    """Let receiving from a socket wait for a time at most; return this time in ns."""
    endpoint.setblocking(True)
    endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("@ll", 0, RECEIVE_WAIT_NS // 1000))
    return RECEIVE_WAIT_NS


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
        import resource  # POSIX only

        _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


def _host(name: SocketName) -> IPv4Address | IPv6Address:
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


def _drop_received(endpoint: Endpoint) -> None:
    """Make the kernel drop received datagrams: by a filter, or else by a minimal buffer."""
    instruction = ctypes.create_string_buffer(struct.pack("=HBBI", _BPF_RETURN, 0, 0, 0))
    program = struct.pack("@HP", 1, ctypes.addressof(instruction))
    with suppress(OSError):
        endpoint.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, program)
    with suppress(OSError):
        endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)
