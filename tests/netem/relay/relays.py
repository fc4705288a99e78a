"""A relay that runs in the thread of its test, and sockets for clients and servers."""

import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from typing import Any

from netem.core.address import Address
from netem.core.udp_sockets import enlarge_buffer
from netem.impairments.link_settings import LinkSettings
from netem.relay.relay import Relay
from netem.relay.relay_links import LinkSpec
from netem.relay.relay_reports import LinkReport

PATIENCE_S = 60
"""Timeout for events that never happen; no test measures time with it."""
HOSTS = {4: "127.0.0.1", 6: "::1"}
Received = list[tuple[bytes, Address]]


class Running:
    """A relay; it runs while the test waits for something."""

    def __init__(self, relay: Relay) -> None:
        self.relay = relay

    def address(self, name: str = "test") -> Address:
        return self.relay.addresses()[name]

    def until(self, condition: Callable[[], bool]) -> None:
        """Relay until a condition holds."""
        late_s = time.monotonic() + PATIENCE_S
        self.relay.run(lambda: condition() or time.monotonic() > late_s, lambda: None)
        assert condition()

    def report(self, number: int = 0) -> LinkReport:
        return self.relay.report()[number]

    def settle(self, received: int, side: str = "forward", number: int = 0) -> None:
        """Relay until ``received`` datagrams have been received and none is in flight."""

        def is_settled() -> bool:
            direction = getattr(self.report(number), side)
            return bool(direction.counters.received >= received and direction.in_flight == 0)

        self.until(is_settled)

    def receive(self, endpoint: socket.socket, count: int = 1) -> Received:
        """Relay until ``count`` datagrams have been received at a socket; return them."""
        received: Received = []

        def is_complete() -> bool:
            received.extend(drain(endpoint))
            return len(received) >= count

        self.until(is_complete)
        return received


@contextmanager
def running(specs: Sequence[LinkSpec], *, segment: bool = False) -> Iterator[Running]:
    """Yield an open relay; it is closed at the end of the block."""
    with closing(Relay(specs, segment=segment)) as relay:
        yield Running(relay)


@contextmanager
def endpoints(*hosts: str) -> Iterator[list[socket.socket]]:
    """Yield a bound socket on each host, with a large buffer."""
    with ExitStack() as stack:
        bound = []
        for host in hosts:
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            endpoint = stack.enter_context(socket.socket(family, socket.SOCK_DGRAM))
            endpoint.bind((host, 0))
            endpoint.setblocking(False)
            enlarge_buffer(endpoint)
            bound.append(endpoint)
        yield bound


def name_of(endpoint: socket.socket) -> Address:
    host, port = endpoint.getsockname()[:2]
    return host, port


def drain(endpoint: socket.socket) -> Received:
    """Read all received datagrams."""
    received: Received = []
    while True:
        try:
            data, source = endpoint.recvfrom(65_536)
        except BlockingIOError:
            return received
        received.append((data, source[:2]))


def link(
    to: Address,
    forward: LinkSettings | None = None,
    reverse: LinkSettings | None = None,
    *,
    host: str = HOSTS[4],
    **settings: Any,
) -> LinkSpec:
    """Return a link on loopback from a free port to a server."""
    fields = {"name": "test", "listen": (host, 0), "seed": 7} | settings
    nothing = LinkSettings()
    return LinkSpec(to=to, forward=forward or nothing, reverse=reverse or nothing, **fields)


@contextmanager
def relayed(
    *settings: LinkSettings,
    clients: int = 1,
    host: str = HOSTS[4],
    segment: bool = False,
    **link_settings: Any,
) -> Iterator[Any]:
    """Yield a server, clients, and a relay with a link between them; see :func:`link`."""
    with endpoints(host, *[host] * clients) as (server, *sockets):
        spec = link(name_of(server), *settings, host=host, **link_settings)
        with running([spec], segment=segment) as emulator:
            yield server, *sockets, emulator
