"""Links with their listening sockets, as every engine begins."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass

from netem.engine.relay_interface import Address, LinkSpec
from netem.engine.relay_sockets import (
    Endpoint,
    ListenAddress,
    address_of,
    leads_to,
    listen,
    one_way_path,
    place_of,
)
from noack.core.errors import CallerError
from noack.runtime.address import text_of
from noack.runtime.udp_sockets import drops_of


@dataclass(frozen=True)
class OpenLink:
    """A link that listens."""

    spec: LinkSpec
    endpoint: Endpoint
    """Where clients send to."""
    server: ListenAddress
    path: Endpoint | None
    """Where it sends from, if it takes no answers; else each client has a path of its own."""

    @property
    def here(self) -> ListenAddress:
        """Where it listens."""
        return ListenAddress(int(self.endpoint.family), self.endpoint.getsockname())

    @property
    def local(self) -> ListenAddress:
        """Where it sends to the server from, unless each client has a path of its own."""
        endpoint = self.path or self.endpoint
        return ListenAddress(int(endpoint.family), endpoint.getsockname())

    @property
    def address(self) -> Address:
        """Where it listens."""
        return address_of(self.endpoint.getsockname())

    @property
    def discarded(self) -> int:
        """Answers that it did not take, as far as the kernel says."""
        return 0 if self.path is None else drops_of(self.path) or 0

    def close(self) -> None:
        """Close its sockets."""
        self.endpoint.close()
        if self.path is not None:
            self.path.close()


def open_links(specs: Sequence[LinkSpec]) -> Sequence[OpenLink]:
    """Bind all links' sockets, or none.

    Raises:
        CallerError: one cannot be bound, or a link makes no sense.
    """
    names = [spec.name for spec in specs]
    for name in names:
        if names.count(name) > 1:
            raise CallerError(f"link {name}: there are two of this name")
    with ExitStack() as undo:
        links = []
        for spec in specs:
            here = place_of(spec.listen, f"link {spec.name}: listen")
            server = place_of(spec.to, f"link {spec.name}: to")
            if spec.to[1] == 0:
                raise CallerError(
                    f"link {spec.name}: to {text_of(spec.to)}: nobody can be at port 0; give the "
                    "server's"
                )
            endpoint = undo.enter_context(listen(spec, here))
            path = None if spec.return_path else undo.enter_context(one_way_path(server))
            links.append(OpenLink(spec, endpoint, server, path))
        _refuse_loops(links)
        undo.pop_all()
    return links


def _refuse_loops(links: Sequence[OpenLink]) -> None:
    """A datagram that comes back would be a new client's each time, and never end."""
    by_port: dict[int, list[tuple[OpenLink, ListenAddress]]] = {}
    for link in links:
        by_port.setdefault(link.address[1], []).append((link, link.here))
    following = {
        link.spec.name: other
        for link in links
        for other, here in by_port.get(link.spec.to[1], ())
        if leads_to(link.server, here)
    }
    for link in links:
        passed = [link.spec.name]
        while (following_link := following.get(passed[-1])) is not None:
            if following_link is link:
                over = f" over {', '.join(passed[1:])}" if len(passed) > 1 else ""
                raise CallerError(
                    f"link {link.spec.name}: {text_of(link.spec.to)} leads back to itself{over}"
                )
            if following_link.spec.name in passed:
                break
            passed.append(following_link.spec.name)
