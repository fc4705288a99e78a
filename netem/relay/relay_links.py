"""A relay's links: what describes one, its sockets, and what the relay reports of it.

In the order of reading: lines for the user; events, which taps receive; :class:`LinkSpec`, and the
reports; sockets over IPv4 and IPv6; and :func:`open_links`, which binds the listening sockets.
"""

import ctypes
import errno
import socket
import struct
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from noack.core.core_library import dtype_of
from noack.core.errors import CallerError
from noack.impairments.link_settings import Counters, Decisions, LinkSettings
from noack.runtime.address import Address, SocketName, address_of, address_text, unpacked_address
from noack.runtime.command_line import print_to_stderr
from noack.runtime.udp_sockets import bind_to, drops_of, enlarge_buffer


def report_line(line: str) -> None:
    """Write a line; if standard error is closed, the emulator continues."""
    print_to_stderr(f"noack netem: {line}")


Bytes = NDArray[np.uint8]
Events = NDArray[np.void]

EVENT = dtype_of("noack_event")
"""One event, with the fields of ``noack_event`` in native/noack.h; the payload is ``data[offset :
offset + size_bytes]``."""


Direction = Literal["forward", "reverse"]
DIRECTIONS: tuple[Direction, Direction] = ("forward", "reverse")
"""From client to server, and from server to client."""


@dataclass(frozen=True)
class LinkSpec:
    """One link of a relay."""

    name: str
    """Name of the link; part of the names of its random streams."""
    listen: Address
    """The address to which clients send; port 0 selects a free port."""
    to: Address
    """The server."""
    forward: LinkSettings
    reverse: LinkSettings
    seed: int = 0
    return_path: bool = True
    """False: forward only; all datagrams leave from one socket, and answers are discarded."""
    idle_s: float = 60.0
    """A client without a datagram in either direction for this time is removed."""
    most_clients: int = 65_536
    """Maximum number of clients; datagrams of further clients are refused and counted."""
    decisions: Mapping[Direction, Decisions] = field(default_factory=dict)
    """Recorded decisions per flow; each flow repeats them before the settings apply."""


class FlowReport(NamedTuple):
    """One flow of a direction."""

    flow: int
    client: str
    """The client's address; in a shell: protocol and both ends."""
    packets: int
    longest_loss_burst: int
    """Maximum number of consecutive datagrams that were not effectively delivered under the present
    settings."""


@dataclass(frozen=True)
class DirectionReport:
    """Counts of one direction of a link since the relay started."""

    settings: LinkSettings
    counters: Counters
    unintended: Mapping[str, int]
    """Unintended losses by cause: ``lost_in_kernel`` (the receive buffer overflowed), or the error
    message for datagrams that could not be sent or stored. Any of them voids the guarantee."""
    in_flight: int
    """Datagrams that are delayed now."""
    flows: Sequence[FlowReport]
    """At most 16: the present clients that sent most."""
    delays: NDArray[np.int64]
    """(k,) Histogram of the time from arrival to departure; see
    :mod:`netem.control.time_histogram`."""
    lateness: NDArray[np.int64]
    """(k,) Histogram of the time from a delayed datagram's release time to its departure."""


@dataclass(frozen=True)
class LinkReport:
    """A link's two directions."""

    name: str
    listen: Address
    to: Address
    clients: int
    """Number of present clients."""
    clients_ever: int
    refused: int
    """Datagrams of clients beyond ``most_clients``."""
    discarded: int
    """Answers to a link without a reverse direction; 0 if the system does not count them."""
    port_unreachable: int
    """ICMP port-unreachable messages from the server's host; a lower bound on the datagrams lost
    there."""
    forward: DirectionReport
    reverse: DirectionReport


class Tap(Protocol):
    """Receives the events of a relay in batches, in the relay's thread; must return quickly."""

    wants_data: bool
    """Whether it needs payloads."""

    def take(self, events: Events, data: Bytes) -> None:
        """Receive events, (k,) of :data:`netem.relay.relay_links.EVENT`, and their payloads.

        Both arrays are overwritten after the call.
        """


_BUFFER_BYTES = 4 * 1024 * 1024
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


def listen(spec: LinkSpec, name: SocketName) -> Endpoint:
    """Return the socket that a link listens on.

    Raises:
        CallerError: the address cannot be bound.
    """
    endpoint = _udp_socket(name)
    title = f"link {spec.name}: UDP port {address_text(spec.listen)}"
    bind_to(endpoint, name, title, "listen on another, or on port 0 for any")
    _prepare(endpoint)
    return endpoint


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
    :func:`noack.runtime.udp_sockets.drops_of`.

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


@dataclass(frozen=True)
class OpenLink:
    """A link with its listening socket."""

    spec: LinkSpec
    endpoint: Endpoint
    """The socket to which clients send."""
    server: SocketName
    path: Endpoint | None
    """The socket that sends to the server, if there is no reverse direction; else None: each client
    has its own return path."""

    @property
    def name(self) -> SocketName:
        """The address at which the link listens, in the form that sockets use."""
        return tuple(self.endpoint.getsockname())

    @property
    def local(self) -> SocketName:
        """The address that sends to the server, unless each client has its own return path."""
        return tuple((self.path or self.endpoint).getsockname())

    @property
    def address(self) -> Address:
        """The address at which the link listens."""
        return address_of(self.name)

    @property
    def has_paths(self) -> bool:
        """Whether each client has a return path."""
        return self.spec.return_path

    def drops(self, reverse: bool) -> int:
        """Return how many datagrams the kernel dropped at the listening socket."""
        return 0 if reverse else drops_of(self.endpoint) or 0

    def client_text(self, name: bytes) -> str:
        """Return a client's packed address as text."""
        return address_text(unpacked_address(name))

    @property
    def discarded(self) -> int:
        """Number of answers that the kernel discarded; 0 if the kernel does not count them."""
        return 0 if self.path is None else drops_of(self.path) or 0

    def close(self) -> None:
        """Close the sockets."""
        self.endpoint.close()
        if self.path is not None:
            self.path.close()


def open_links(specs: Sequence[LinkSpec]) -> Sequence[OpenLink]:
    """Bind the sockets of all links; if one fails, close them all.

    Raises:
        CallerError: a socket cannot be bound, or a link is invalid.
    """
    names = [spec.name for spec in specs]
    for name in names:
        if names.count(name) > 1:
            raise CallerError(f"link {name}: there are two of this name")
    with ExitStack() as undo:
        links = []
        for spec in specs:
            own_name = socket_name(spec.listen, f"link {spec.name}: listen")
            server = socket_name(spec.to, f"link {spec.name}: to")
            if spec.to[1] == 0:
                raise CallerError(
                    f"link {spec.name}: to {address_text(spec.to)}: port 0 is no destination; give its port"
                )
            endpoint = undo.enter_context(listen(spec, own_name))
            path = None if spec.return_path else undo.enter_context(one_way_path(server))
            links.append(OpenLink(spec, endpoint, server, path))
        _refuse_loops(links)
        undo.pop_all()
    return links


def _refuse_loops(links: Sequence[OpenLink]) -> None:
    """Refuse links that form a loop: each returning datagram would count as a new client's."""
    by_port: defaultdict[int, list[tuple[OpenLink, SocketName]]] = defaultdict(list)
    for link in links:
        by_port[link.address[1]].append((link, link.name))
    following = {
        link.spec.name: next_link
        for link in links
        for next_link, name in by_port.get(link.spec.to[1], ())
        if leads_to(link.server, name)
    }
    for link in links:
        passed = [link.spec.name]
        while (following_link := following.get(passed[-1])) is not None:
            if following_link is link:
                over = f" over {', '.join(passed[1:])}" if len(passed) > 1 else ""
                raise CallerError(
                    f"link {link.spec.name}: {address_text(link.spec.to)} leads back to itself{over}"
                )
            if following_link.spec.name in passed:
                break
            passed.append(following_link.spec.name)
