"""A relay's links: :class:`LinkSpec`, and :func:`open_links`, which binds the listening sockets."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field

from netem.relay.link_sockets import Endpoint, leads_to, listen, one_way_path, socket_name
from netem.relay.relay_reports import Direction
from noack.core.errors import CallerError
from noack.impairments.link_settings import Decisions, LinkSettings
from noack.runtime.address import Address, SocketName, address_of, address_text, unpacked_address
from noack.runtime.udp_sockets import drops_of


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
