"""The portable engine: plain sockets around ``link_machine.Link``, one datagram at a time."""

import errno
import select
import selectors
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from netem.engine.link_listeners import OpenLink
from netem.engine.plain_direction import (
    PlainDirection,
    PlainTaps,
    ScheduledDeparture,
    TapRoute,
)
from netem.engine.relay_base import RARE_PERIOD_NS, REPORTED_FLOWS, STALL_NS, Relay, has_headroom
from netem.engine.relay_interface import (
    DIRECTIONS,
    Address,
    DirectionReport,
    FlowReport,
    LinkSpec,
    Tap,
)
from netem.engine.relay_sockets import Endpoint, address_of, has_data, icmp_errors, return_path
from noack.impairments.link_settings import LinkSettings
from noack.runtime.udp_sockets import MAX_UDP_BYTES, drops_of

_NS = 1_000_000_000
_BATCH = 64
_TRIES, _MOST_TRIES = 3, 64
_PATIENCE_S = 0.05
"""See :mod:`netem.engine.pump.pump_send`."""


@dataclass
class _Client:
    number: int
    name: Any
    """The client's address in the form that sockets use."""
    path: Endpoint | None
    error: int
    """errno: why there is no return path; 0 if there is one."""
    local: Address
    """Local address of the return path."""
    last_ns: int
    in_flight: int = 0


@dataclass
class _PlainLink:
    """A link with its clients."""

    number: int
    link: OpenLink
    clients: dict[Any, _Client] = field(default_factory=dict)
    by_number: dict[int, _Client] = field(default_factory=dict)
    clients_ever: int = 0
    closed_drops: int = 0
    refused: int = 0
    port_unreachable: int = 0

    def take_errors(self, endpoint: Endpoint) -> bool:
        """Empty a socket's error queue; return whether there were ICMP errors."""
        errors = icmp_errors(endpoint)
        if endpoint is not self.link.endpoint:
            self.port_unreachable += errors.count(errno.ECONNREFUSED)
        return bool(errors)


class PlainRelay(Relay):
    """A relay that runs everywhere; the taps receive all its events."""

    engine = "plain"

    def __init__(self, specs: Sequence[LinkSpec], taps: Sequence[Tap] = ()) -> None:
        # Opened before any link: select supports low file descriptors only.
        self._selector = selectors.DefaultSelector()
        super().__init__(specs)
        self._links = [_PlainLink(*one) for one in enumerate(self._open_links)]
        self._directions = [PlainDirection(spec, one) for spec in specs for one in DIRECTIONS]
        self._taps = PlainTaps(taps)
        for link in self._links:
            self._selector.register(link.link.endpoint, selectors.EVENT_READ, (link, None))
        self._rarely_ns = 0
        self._no_memory = False

    def close(self) -> None:
        """Close all sockets."""
        super().close()
        self._selector.close()
        for link in self._links:
            for client in link.clients.values():
                if client.path is not None:
                    client.path.close()

    def _relay_until(self, until_ns: int) -> None:
        self._taps.unix_ns = self.began_unix_ns or 0
        # Until the next check, new datagrams use less memory than the headroom.
        self._no_memory = not has_headroom()
        while (now_ns := self._now_ns()) < until_ns:
            self._send_due(now_ns)
            for link, client in self._wait(until_ns):
                self._receive(link, client)
        self._taps.report()

    def _change(self, direction: int, settings: LinkSettings) -> None:
        self._directions[direction].change(settings)

    def _link_counts(self, link: int) -> tuple[int, int, int, int]:
        one = self._links[link]
        return len(one.clients), one.clients_ever, one.refused, one.port_unreachable

    def _report_direction(self, direction: int) -> DirectionReport:
        flows = []
        of = self._directions[direction]
        for client in self._links[direction // 2].clients.values():
            flow = of.link.flow(client.number)
            counts = (flow.packets, flow.longest_loss_burst) if flow is not None else (0, 0)
            flows.append(FlowReport(client.number, address_of(client.name), *counts))
        busiest = sorted(flows, key=lambda flow: -flow.packets)[:REPORTED_FLOWS]
        return of.report(busiest, self._losses[direction].counts())

    def _wait(self, until_ns: int) -> Iterable[tuple[_PlainLink, _Client | None]]:
        """Wait for datagrams or the next departure; return the sockets that are ready."""
        deadlines_ns = [one.link.next_deadline_ns() for one in self._directions]
        wake_ns = min([until_ns, *(t_ns for t_ns in deadlines_ns if t_ns is not None)])
        wait_s = max(wake_ns - self._now_ns(), 0) / _NS
        if isinstance(self._selector, selectors.EpollSelector):
            # The timeout of epoll has a resolution of 1 ms only.
            ready, _, _ = select.select([self._selector.fileno()], [], [], wait_s)
            wait_s = 0
            if not ready:
                return []
        return [key.data for key, _ in self._selector.select(wait_s)]

    def _receive(self, link: _PlainLink, client: _Client | None) -> None:
        """Receive the datagrams at a socket: a client's return path, or the listening socket."""
        endpoint = client.path if client is not None else link.link.endpoint
        if endpoint is None:
            return
        for number in range(_BATCH):
            try:
                data, source = endpoint.recvfrom(MAX_UDP_BYTES)
            except OSError as failure:
                is_empty = isinstance(failure, BlockingIOError)
                if not (is_empty and number):  # else the socket was ready because of an ICMP error
                    link.take_errors(endpoint)
                if is_empty:
                    return
                continue
            now_ns = self._now_ns()
            self._send_due(now_ns)
            sender = client or link.clients.get(source) or self._add(link, source, now_ns)
            if sender is None:
                link.refused += 1
                continue
            sender.last_ns = now_ns
            self._admit(link, client is not None, sender, data, now_ns)

    def _admit(
        self, link: _PlainLink, reverse: bool, client: _Client, data: bytes, now_ns: int
    ) -> None:
        """Decide for a datagram; send it if it leaves at once."""
        direction = self._directions[2 * link.number + reverse]
        if self._no_memory and direction.link.delays:
            direction.errors[errno.ENOMEM] += 1
            return
        decision, departures = direction.admit(client.number, data, now_ns)
        client.in_flight += (decision.release_ns > now_ns) + (decision.copy_ns > now_ns)
        if self._taps:
            route = self._route(link, reverse, client)
            self._taps.arrival(route, client.number, data, decision, now_ns)
        for departure in departures:
            self._send(link, reverse, client, departure)

    def _send_due(self, now_ns: int) -> None:
        """Send the datagrams that are due, those of a direction in order of release time."""
        for number, direction in enumerate(self._directions):
            link = self._links[number // 2]
            for departure in direction.due(now_ns):
                client = link.by_number[departure.flow]
                client.in_flight -= 1
                self._send(link, number % 2 == 1, client, departure)

    def _send(
        self, link: _PlainLink, reverse: bool, client: _Client, departure: ScheduledDeparture
    ) -> None:
        direction = self._directions[2 * link.number + reverse]
        if reverse:
            error = _transmit(link, link.link.endpoint, departure.data, client.name)
        elif link.link.path is not None:
            error = _transmit(link, link.link.path, departure.data, link.link.server)
        elif client.path is not None:
            error = _transmit(link, client.path, departure.data, None)
        else:
            error = client.error
        if error:
            direction.errors[error] += 1
            return
        now_ns = self._now_ns()
        direction.sent(departure, now_ns)
        if self._taps:
            self._taps.departure(self._route(link, reverse, client), departure, now_ns)

    def _route(self, link: _PlainLink, reverse: bool, client: _Client) -> TapRoute:
        mansd = self._directions[2 * link.number + reverse].settings.longest_burst
        return TapRoute(
            link.number, reverse, -1 if mansd is None else mansd, address_of(client.name),
            link.link.address, client.local, link.link.spec.to,
        )  # fmt: skip

    def _add(self, link: _PlainLink, name: Any, now_ns: int) -> _Client | None:
        """Add a client; return None if there are too many."""
        warnings, present = self._warnings[link.number], len(link.clients)
        if not warnings.accepts_client(present):
            return None
        path, error = return_path(link.link.server) if link.link.spec.return_path else (None, 0)
        if warnings.no_descriptor_left(error, present):
            return None
        local = address_of(link.link.local)
        client = _Client(link.clients_ever, name, path, error, local, now_ns)
        link.clients_ever += 1
        link.clients[name] = client
        link.by_number[client.number] = client
        if path is not None:
            self._set_path(link, client, path)
        return client

    def _set_path(self, link: _PlainLink, client: _Client, path: Endpoint) -> None:
        client.path = path
        client.local = address_of(path.getsockname())
        self._selector.register(path, selectors.EVENT_READ, (link, client))

    def _keep_house(self, now_ns: int) -> None:
        if now_ns < self._rarely_ns:
            return
        stalled = now_ns - self._rarely_ns > STALL_NS - RARE_PERIOD_NS
        self._rarely_ns = now_ns + RARE_PERIOD_NS
        self._update_losses()
        for link in self._links:
            idle_ns = round(link.link.spec.idle_s * _NS)
            for client in list(link.clients.values()):
                if stalled:  # datagrams that arrived meanwhile have not been read
                    client.last_ns = now_ns
                if client.last_ns < now_ns - idle_ns and not client.in_flight:
                    self._forget(link, client)
                elif client.error:
                    path, client.error = return_path(link.link.server)
                    if path is not None:
                        self._set_path(link, client, path)

    def _forget(self, link: _PlainLink, client: _Client) -> None:
        if client.path is not None:
            if has_data(client.path):
                return
            link.closed_drops += drops_of(client.path) or 0
            self._selector.unregister(client.path)
            client.path.close()
        del link.clients[client.name], link.by_number[client.number]
        for direction in self._directions[2 * link.number : 2 * link.number + 2]:
            direction.link.forget(client.number)
        self._warnings[link.number].client_removed()

    def _path_drops(self, link: int) -> int:
        clients = self._links[link].clients.values()
        paths = [client.path for client in clients if client.path is not None]
        return self._links[link].closed_drops + sum(drops_of(path) or 0 for path in paths)

    def _send_errors(self) -> Iterator[tuple[int, int, int]]:
        for number, direction in enumerate(self._directions):
            for error, datagrams in direction.errors.items():
                yield number, error, datagrams


def _transmit(link: _PlainLink, endpoint: Endpoint, data: bytes, name: Any) -> int:
    """Send a datagram; return 0, or the errno of a permanent failure."""
    tries, give_up_s = 0, time.monotonic() + _PATIENCE_S
    while True:
        try:
            if name is None:
                endpoint.send(data)
            else:
                endpoint.sendto(data, name)
        except OSError as failure:
            error = failure.errno or errno.EIO
            if error == errno.EAGAIN and time.monotonic() < give_up_s:
                time.sleep(0.001)
                continue
            if error in (errno.EAGAIN, errno.ENOBUFS):
                return error
            tries += 1
            if tries >= (_MOST_TRIES if link.take_errors(endpoint) else _TRIES):
                return error
        else:
            return 0
