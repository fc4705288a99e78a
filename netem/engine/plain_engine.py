"""The portable engine: plain sockets around ``link_machine.Link``, one datagram at a time."""

import errno
import select
import selectors
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from netem.engine.headroom import has_headroom
from netem.engine.link_listeners import OpenLink, open_links
from netem.engine.plain_direction import PlainDirection, ScheduledDeparture
from netem.engine.plain_taps import PlainTaps, TapDirection, TapEndpoints
from netem.engine.refused_clients import STOPPED_NS, RefusedClients
from netem.engine.relay_interface import (
    DIRECTIONS,
    Address,
    Direction,
    FlowReport,
    LinkReport,
    LinkSpec,
    Tap,
)
from netem.engine.relay_sockets import (
    Endpoint,
    address_of,
    has_data,
    icmp_errors,
    raise_file_limit,
    return_path,
)
from netem.engine.unreachable_servers import UnreachableServers
from noack.core.errors import CallerError
from noack.impairments.link_settings import LinkSettings
from noack.runtime.udp_sockets import MAX_UDP_BYTES, drops_of

_PERIOD_NS = 20_000_000
_RARELY_NS = 250_000_000
_NS = 1_000_000_000
_BATCH = 64
_TRIES, _MOST_TRIES = 3, 64
_PATIENCE_S = 0.05
"""See :mod:`netem.engine.pump.pump_send`."""
_REPORTED_FLOWS = 16


@dataclass
class _Client:
    number: int
    place: Any
    """The client's address in the form that sockets use."""
    path: Endpoint | None
    error: int
    """errno: why there is no return path; 0 if there is one."""
    local: Address
    """Local address of the return path."""
    last_ns: int
    in_flight: int = 0
    drops: int = 0


class _PlainLink:
    """A link with its clients."""

    def __init__(self, number: int, link: OpenLink) -> None:
        self.number, self.link = number, link
        spec = link.spec
        self.ways = (
            PlainDirection(spec, "forward", spec.forward),
            PlainDirection(spec, "reverse", spec.reverse),
        )
        self.clients: dict[Any, _Client] = {}
        self.by_number: dict[int, _Client] = {}
        self.ever = 0
        self.closed_drops = 0
        self.refused = 0
        self.port_unreachable = 0
        self.refusals = RefusedClients(spec)
        self.unreachable = UnreachableServers(spec)

    def take_errors(self, endpoint: Endpoint) -> bool:
        """Empty a socket's error queue; return whether there were ICMP errors."""
        found = icmp_errors(endpoint)
        if endpoint is not self.link.endpoint:
            self.port_unreachable += found.count(errno.ECONNREFUSED)
        return bool(found)

    def way(self, back: bool) -> TapDirection:
        """Return a direction as reported to taps."""
        mansd = self.ways[back].settings.mansd
        return TapDirection(self.number, back, -1 if mansd is None else mansd)

    def ends(self, client: _Client) -> TapEndpoints:
        """Return the addresses between which a client's datagrams are sent."""
        spec = self.link.spec
        return TapEndpoints(address_of(client.place), self.link.address, client.local, spec.to)


class PlainRelay:
    """See :class:`netem.engine.relay_interface.Relay`; all of it is called in one thread.

    Args:
        specs: the links.
        taps: receivers of all events.

    Raises:
        CallerError: a socket cannot be bound, or a link is invalid.
    """

    engine = "plain"

    def __init__(self, specs: Sequence[LinkSpec], taps: Sequence[Tap] = ()) -> None:
        self.specs: Sequence[LinkSpec] = tuple(specs)
        raise_file_limit()
        # Opened before any link: select supports low file descriptors only.
        self._selector = selectors.DefaultSelector()
        self._links = [_PlainLink(*one) for one in enumerate(open_links(self.specs))]
        self._taps = PlainTaps(taps)
        for link in self._links:
            self._selector.register(link.link.endpoint, selectors.EVENT_READ, (link, None))
        self._epoch_ns = 0
        self._rarely_ns = 0
        self._no_memory = False
        self.began_unix_ns: int | None = None
        """Unix time at which the relay started to run; the origin of its times."""

    def addresses(self) -> Mapping[str, Address]:
        """Return the address at which each link listens."""
        return {link.link.spec.name: link.link.address for link in self._links}

    def run(self, stop: Callable[[], bool], housekeeping: Callable[[], None]) -> None:
        """Relay until ``stop()``; both are called every 20 ms, in this thread."""
        if self.began_unix_ns is None:
            self._epoch_ns = time.monotonic_ns()
            self.began_unix_ns = time.time_ns()
            self._taps.unix_ns = self.began_unix_ns
        while not stop():
            housekeeping()
            # Until the next check, new datagrams use less memory than the headroom.
            self._no_memory = not has_headroom()
            self._keep_house()
            until_ns = self._now_ns() + _PERIOD_NS
            while (now_ns := self._now_ns()) < until_ns:
                self._let_out(now_ns)
                for link, client in self._wait(until_ns):
                    self._take(link, client)
            self._taps.tell()
        self._look_at_losses()
        for link in self._links:
            for way in link.ways:
                way.losses.tell()

    def change(self, link: str, direction: Direction, settings: LinkSettings) -> None:
        """Change a direction's impairments; see :meth:`netem.engine.relay_interface.Relay.change`.

        Raises:
            CallerError: there is no such link.
        """
        for one in self._links:
            if one.link.spec.name == link:
                one.ways[DIRECTIONS.index(direction)].change(settings)
                return
        names = ", ".join(spec.name for spec in self.specs)
        raise CallerError(f"link {link}: there is none of this name, but {names}")

    def report(self) -> Sequence[LinkReport]:
        """Return the counts so far."""
        self._look_at_losses()
        return [
            LinkReport(
                name=link.link.spec.name,
                listen=link.link.address,
                to=link.link.spec.to,
                clients=len(link.clients),
                clients_ever=link.ever,
                refused=link.refused,
                discarded=link.link.discarded,
                port_unreachable=link.port_unreachable,
                forward=link.ways[0].report(_flows(link, link.ways[0])),
                reverse=link.ways[1].report(_flows(link, link.ways[1])),
            )
            for link in self._links
        ]

    def close(self) -> None:
        """Close all sockets."""
        self._selector.close()
        for link in self._links:
            link.link.close()
            for client in link.clients.values():
                if client.path is not None:
                    client.path.close()

    def _now_ns(self) -> int:
        return time.monotonic_ns() - self._epoch_ns

    def _wait(self, until_ns: int) -> Iterable[tuple[_PlainLink, _Client | None]]:
        """Wait for datagrams or the next departure; return the sockets that are ready."""
        deadlines_ns = [way.link.next_deadline_ns() for link in self._links for way in link.ways]
        wake_ns = min([until_ns, *(t_ns for t_ns in deadlines_ns if t_ns is not None)])
        wait_s = max(wake_ns - self._now_ns(), 0) / _NS
        if isinstance(self._selector, selectors.EpollSelector):
            # The timeout of epoll has a resolution of 1 ms only.
            ready, _, _ = select.select([self._selector.fileno()], [], [], wait_s)
            wait_s = 0
            if not ready:
                return []
        return [key.data for key, _ in self._selector.select(wait_s)]

    def _take(self, link: _PlainLink, client: _Client | None) -> None:
        """Receive the datagrams at a socket: a client's return path, or the listening socket."""
        back = client is not None
        endpoint = client.path if client is not None else link.link.endpoint
        if endpoint is None:
            return
        way = link.ways[back]
        for number in range(_BATCH):
            try:
                data, source = endpoint.recvfrom(MAX_UDP_BYTES)
            except OSError as failure:
                nothing = isinstance(failure, BlockingIOError)
                if not (nothing and number):  # else the socket was ready because of an ICMP error
                    link.take_errors(endpoint)
                if nothing:
                    return
                continue
            now_ns = self._now_ns()
            self._let_out(now_ns)
            sender = client or link.clients.get(source) or self._add(link, source, now_ns)
            if sender is None:
                link.refused += 1
                continue
            sender.last_ns = now_ns
            if self._no_memory and way.link.delays:
                way.errors[errno.ENOMEM] += 1
                continue
            verdict, departures = way.admit(sender.number, data, now_ns)
            sender.in_flight += (verdict.release_ns > now_ns) + (verdict.copy_ns > now_ns)
            if self._taps:
                self._taps.arrival(
                    link.way(back), link.ends(sender), sender.number, data, verdict, now_ns
                )
            for departure in departures:
                self._send(link, back, sender, departure)

    def _let_out(self, now_ns: int) -> None:
        """Send all datagrams that are due, in order of release time."""
        due: list[tuple[int, int, _PlainLink, int]] = []
        while True:
            due = [
                (t_ns, link.number, link, side)
                for link in self._links
                for side, way in enumerate(link.ways)
                if (t_ns := way.link.next_deadline_ns()) is not None and t_ns <= now_ns
            ]
            if not due:
                return
            for _, _, link, side in due:
                for departure in link.ways[side].due(now_ns):
                    client = link.by_number[departure.flow]
                    client.in_flight -= 1
                    self._send(link, side == 1, client, departure)

    def _send(
        self, link: _PlainLink, back: bool, client: _Client, departure: ScheduledDeparture
    ) -> None:
        way, error = link.ways[back], 0
        if back:
            error = _transmit(link, link.link.endpoint, departure.data, client.place)
        elif link.link.path is not None:
            error = _transmit(link, link.link.path, departure.data, link.link.server.address)
        elif client.path is not None:
            error = _transmit(link, client.path, departure.data, None)
        else:
            error = client.error
        if error:
            way.errors[error] += 1
            return
        now_ns = self._now_ns()
        way.sent(departure, now_ns)
        if self._taps:
            self._taps.departure(link.way(back), link.ends(client), departure, now_ns)

    def _add(self, link: _PlainLink, place: Any, now_ns: int) -> _Client | None:
        """Add a client; return None if there are too many."""
        path, error = None, 0
        if not link.refusals.accepts(len(link.clients)):
            return None
        if link.link.spec.return_path:
            try:
                path = return_path(link.link.server)
            except OSError as failure:
                error = failure.errno or errno.EIO
                if link.refusals.is_exhausted(error, len(link.clients)):
                    return None
        local = address_of(link.link.local.address)
        client = _Client(link.ever, place, path, error, local, now_ns)
        link.ever += 1
        link.clients[place] = client
        link.by_number[client.number] = client
        if path is not None:
            self._set_path(link, client, path)
        return client

    def _set_path(self, link: _PlainLink, client: _Client, path: Endpoint) -> None:
        client.path, client.error = path, 0
        client.local = address_of(path.getsockname())
        self._selector.register(path, selectors.EVENT_READ, (link, client))

    def _keep_house(self) -> None:
        now_ns = self._now_ns()
        if now_ns < self._rarely_ns:
            return
        stopped = now_ns - self._rarely_ns > STOPPED_NS - _RARELY_NS
        self._rarely_ns = now_ns + _RARELY_NS
        self._look_at_losses()
        for link in self._links:
            idle_ns = round(link.link.spec.idle_s * _NS)
            for client in list(link.clients.values()):
                if stopped:  # datagrams that arrived meanwhile have not been read
                    client.last_ns = now_ns
                if client.last_ns < now_ns - idle_ns and not client.in_flight:
                    self._forget(link, client)
                elif client.error:
                    self._reconnect(link, client)

    def _reconnect(self, link: _PlainLink, client: _Client) -> None:
        try:
            path = return_path(link.link.server)
        except OSError as failure:
            client.error = failure.errno or errno.EIO
        else:
            self._set_path(link, client, path)

    def _forget(self, link: _PlainLink, client: _Client) -> None:
        if client.path is not None:
            if has_data(client.path):
                return
            link.closed_drops += drops_of(client.path) or 0
            self._selector.unregister(client.path)
            client.path.close()
        del link.clients[client.place], link.by_number[client.number]
        for way in link.ways:
            way.link.forget(client.number)
        link.refusals.end()

    def _look_at_losses(self) -> None:
        for link in self._links:
            link.unreachable.seen(link.port_unreachable)
            link.ways[0].losses.lost_in_kernel(drops_of(link.link.endpoint) or 0)
            paths = [client.path for client in link.clients.values() if client.path is not None]
            drops = link.closed_drops + sum(drops_of(path) or 0 for path in paths)
            link.ways[1].losses.lost_in_kernel(drops)


def _flows(link: _PlainLink, way: PlainDirection) -> Sequence[FlowReport]:
    known = []
    for client in link.clients.values():
        flow = way.link.flow(client.number)
        packets, longest = (flow.packets, flow.longest_loss_burst) if flow is not None else (0, 0)
        known.append(FlowReport(client.number, address_of(client.place), packets, longest))
    return sorted(known, key=lambda flow: -flow.packets)[:_REPORTED_FLOWS]


def _transmit(link: _PlainLink, endpoint: Endpoint, data: bytes, place: Any) -> int:
    """Send a datagram; return 0, or the errno of a permanent failure."""
    tries, give_up_s = 0, time.monotonic() + _PATIENCE_S
    while True:
        try:
            if place is None:
                endpoint.send(data)
            else:
                endpoint.sendto(data, place)
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
