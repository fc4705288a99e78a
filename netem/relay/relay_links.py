"""A relay's links: as described, with bound sockets, or between the two devices of a shell.

:func:`open_links` binds the listening sockets.
"""

import fcntl
import os
import socket
import struct
from collections import defaultdict
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field

from netem.core.address import Address, SocketName, address_of, address_text, unpacked_address
from netem.core.errors import CallerError
from netem.core.udp_sockets import drops_of
from netem.impairments.link_settings import LinkSettings
from netem.relay.link_sockets import Endpoint, leads_to, listen, one_way_path, socket_name
from netem.relay.relay_reports import DIRECTIONS, Direction, report_line

_DROPPED = 11
"""Column of /proc/net/dev with the packets that a full device did not take."""
_GET_INTERFACE, _REQUEST_BYTES = 0x800454D2, 40
"""Request of ioctl TUNGETIFF, and the size of what it fills in, which begins with the name."""


STREAM = "relay"
"""Name of a link's random streams, whatever its own name: fates depend on its words and its seed alone."""


@dataclass(frozen=True)
class LinkSpec:
    """One link of a relay."""

    name: str
    """Name of the link in reports."""
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
    stream: str = field(default=STREAM, compare=False)
    """Name of its random streams; another one for a further link of a file without a seed of its own."""
    most_clients: int = 65_536
    """Maximum number of clients; datagrams of further clients are refused and counted."""


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
    def address(self) -> Address:
        """The address at which the link listens."""
        return address_of(self.name)

    @property
    def has_paths(self) -> bool:
        """Whether each client has a return path."""
        return self.spec.return_path

    def drops(self, direction: Direction) -> int:
        """Return how many datagrams the kernel dropped at the listening socket, which is forward."""
        return (drops_of(self.endpoint) or 0) if direction == "forward" else 0

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


@dataclass(frozen=True)
class DeviceLink:
    """The link of a shell, between two TUN devices, which :mod:`netem.shell.devices` opens."""

    spec: LinkSpec
    devices: tuple[int, int]
    """The device inside, and the one outside."""
    statistics: tuple[int, int]
    """/proc/net/dev of the two namespaces, whose place in the file system does not matter."""
    namespace: int
    """The network namespace inside."""
    outside6: str | None
    """The address outside of IPv6, if the system has it."""
    _drops: list[int] = field(default_factory=lambda: [0, 0])
    """What the devices have dropped, when last read; the command may delete or rename a device."""
    _deleted: set[int] = field(default_factory=set)
    """The devices that were found to be deleted, which is reported."""

    discarded = 0
    has_paths = False

    @property
    def name(self) -> SocketName:
        """The address inside, in the form that sockets use."""
        return self.spec.listen

    @property
    def server(self) -> SocketName:
        """The address outside. Nothing is sent there by address."""
        return self.spec.to

    @property
    def address(self) -> Address:
        """The address inside."""
        return self.spec.listen

    def drops(self, direction: Direction) -> int:
        """Return how many packets a direction lost because a device was full."""
        side = DIRECTIONS.index(direction)
        name = self.device_name(side)
        if name is None and side not in self._deleted:
            self._deleted.add(side)
            where = ("inside", "outside")[side]
            report_line(f"the shell's device {where} was deleted: its packets pass no more")
        for line in _read_whole(self.statistics[side]).splitlines():
            device, _, counts = line.partition(":")
            if device.strip() == name:
                self._drops[side] = int(counts.split()[_DROPPED])
        return self._drops[side]

    def device_name(self, side: int) -> str | None:
        """Return the present name of the device inside (0) or outside (1); None if it was deleted."""
        try:
            answer = fcntl.ioctl(self.devices[side], _GET_INTERFACE, bytes(_REQUEST_BYTES))
        except OSError:
            return None
        return answer.partition(b"\0")[0].decode()

    def client_text(self, flow: bytes) -> str:
        """Return a flow as text: protocol, end inside, end outside."""
        version, protocol, is_fragment, _, inner_port, outer_port = struct.unpack_from("!4BHH", flow)
        if version == 0:
            return "not IP"
        size, family = (4, socket.AF_INET) if version == 4 else (16, socket.AF_INET6)
        hosts = (socket.inet_ntop(family, flow[begin : begin + size]) for begin in (8, 24))
        names = {1: "icmp", 6: "tcp", 17: "udp", 58: "icmpv6"}
        words = [names.get(protocol, f"protocol {protocol}")]
        if is_fragment:
            words[0] += " fragments"
        words += [
            f"{host if version == 4 else f'[{host}]'}{f':{port}' if port else ''}"
            for host, port in zip(hosts, (inner_port, outer_port), strict=True)
        ]
        return " ".join(words)

    def close(self) -> None:
        """Close the devices, which end with that."""
        for descriptor in (*self.devices, *self.statistics, self.namespace):
            os.close(descriptor)


def _read_whole(descriptor: int) -> str:
    """Return the text of a file of the system, of which one call returns some kilobytes."""
    parts = list[bytes]()
    while part := os.pread(descriptor, 65536, sum(map(len, parts))):
        parts.append(part)
    return b"".join(parts).decode()


def open_links(specs: Sequence[LinkSpec]) -> Sequence[OpenLink]:
    """Bind the sockets of all links; if one fails, close them all.

    Raises:
        CallerError: a socket cannot be bound, or a link is invalid.
    """
    names = [spec.name for spec in specs]
    for name in names:
        if names.count(name) > 1:
            raise CallerError(f"link {name}: two links have this name")
    with ExitStack() as undo:
        links = []
        for spec in specs:
            own_name = socket_name(spec.listen, f"link {spec.name}: listen")
            server = socket_name(spec.to, f"link {spec.name}: to")
            if spec.to[1] == 0:
                raise CallerError(
                    f"link {spec.name}: to {address_text(spec.to)}: port 0 is not a destination; "
                    "give its port"
                )
            title = f"link {spec.name}: UDP port {address_text(spec.listen)}"
            endpoint = undo.enter_context(listen(title, own_name))
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
        passed_names = [link.spec.name]
        while (following_link := following.get(passed_names[-1])) is not None:
            if following_link is link:
                over = f" over {', '.join(passed_names[1:])}" if len(passed_names) > 1 else ""
                raise CallerError(
                    f"link {link.spec.name}: {address_text(link.spec.to)} leads back to itself{over}"
                )
            if following_link.spec.name in passed_names:
                break
            passed_names.append(following_link.spec.name)
