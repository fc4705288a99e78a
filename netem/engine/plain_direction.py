"""A direction of a link in the portable engine, its counters, and the events that taps receive."""

import ipaddress
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from netem.engine.histogram import bucket_of, empty
from netem.engine.relay_interface import (
    Address,
    Direction,
    DirectionReport,
    FlowReport,
    LinkSpec,
    Tap,
)
from netem.link_machine import Datagram, Link
from netem.relay_events import ADDRESS_BYTES, EVENT
from noack.impairments.link_records import NEVER_NS
from noack.impairments.link_settings import LinkSettings
from noack.protocol.machine_interface import Record
from noack.protocol.record_tables import NETEM_RELEASE

_MOST_EVENTS = 512


class ScheduledDeparture(NamedTuple):
    """A datagram or a copy to be sent."""

    flow: int
    data: bytes
    packet: int
    fate: int
    arrival_ns: int
    release_ns: int
    bit: int
    delayed: bool
    copy: bool
    stale: bool = False


class PlainDirection:
    """One direction of a link."""

    def __init__(self, spec: LinkSpec, direction: Direction) -> None:
        self.settings: LinkSettings = getattr(spec, direction)
        decisions = spec.decisions.get(direction, ())
        self.link = Link(self.settings, spec.seed, spec.name, direction, decisions=decisions)
        self.errors: Counter[int] = Counter()
        """Number of datagrams that could not be sent or stored, by errno."""
        self._delays, self._lateness = empty(), empty()
        self._in_flight: dict[tuple[int, int, int], ScheduledDeparture] = {}
        """By flow, packet and copy."""

    def admit(
        self, flow: int, data: bytes, now_ns: int
    ) -> tuple[Any, Sequence[ScheduledDeparture]]:
        """Decide for a datagram; return the departures that are due at once."""
        outputs = self.link.handle(Datagram(flow, data), now_ns)
        datagrams = iter([output for output in outputs if isinstance(output, Datagram)])
        decision = self.link.decision
        departures = []
        for copy, t_ns, bit in (
            (False, decision.release_ns, decision.bit),
            (True, decision.copy_ns, decision.copy_bit),
        ):
            departure = ScheduledDeparture(
                flow, data, decision.packet, decision.fate, now_ns, t_ns, bit,
                delayed=t_ns > now_ns, copy=copy,
            )  # fmt: skip
            if t_ns > now_ns:
                self._in_flight[flow, decision.packet, copy] = departure
            elif t_ns == now_ns:
                departures.append(departure._replace(data=next(datagrams).data))
        return decision, departures

    def due(self, now_ns: int) -> Iterator[ScheduledDeparture]:
        """Yield the departures that are due, one by one."""
        while (deadline_ns := self.link.next_deadline_ns()) is not None and deadline_ns <= now_ns:
            datagram, record = self.link.on_timer(now_ns)
            if not isinstance(datagram, Datagram) or not isinstance(record, Record):
                raise TypeError(f"not a datagram with a {NETEM_RELEASE}: {datagram}, {record}")
            _, packet, _, _, flow, copy, stale = record.row
            departure = self._in_flight.pop((flow, packet, copy))
            yield departure._replace(data=datagram.data, stale=bool(stale))

    def sent(self, departure: ScheduledDeparture, now_ns: int) -> None:
        """Record that a datagram was sent."""
        self._delays[bucket_of(now_ns - departure.arrival_ns)] += 1
        if departure.delayed:
            self._lateness[bucket_of(now_ns - departure.release_ns)] += 1

    def change(self, settings: LinkSettings) -> None:
        """Apply other settings."""
        self.settings = settings
        self.link.change(settings)

    def report(self, flows: Sequence[FlowReport], unintended: Mapping[str, int]) -> DirectionReport:
        """Return the counts so far."""
        return DirectionReport(
            self.settings, replace(self.link.counters), unintended, self.link.in_flight, flows,
            self._delays.copy(), self._lateness.copy(),
        )  # fmt: skip


class TapRoute(NamedTuple):
    """A direction of a link, and the addresses between which a client's datagrams are sent."""

    link: int
    reverse: bool
    mansd: int
    client: Address
    listen: Address
    path: Address
    """The client's return path."""
    server: Address


class PlainTaps:
    """Taps, and the events that have not been passed to them yet."""

    def __init__(self, taps: Sequence[Tap]) -> None:
        self._taps = tuple(taps)
        self._data = bytearray()
        self._wants_data = any(tap.wants_data for tap in taps)
        self._events = np.zeros(_MOST_EVENTS, EVENT)
        self._count = 0
        self.unix_ns = 0
        """Unix time at which the relay started to run."""

    def __bool__(self) -> bool:
        return bool(self._taps)

    def arrival(self, route: TapRoute, flow: int, data: bytes, decision: Any, now_ns: int) -> None:
        """Report the arrival of a datagram and the decision."""
        event = self._add(route, route.reverse, data, now_ns)
        event["flow"], event["packet"], event["fate"] = flow, decision.packet, decision.fate
        event["consecutive_losses"] = decision.consecutive_losses
        event["delay_ns"] = _delay(decision.release_ns, now_ns)
        event["copy_delay_ns"] = _delay(decision.copy_ns, now_ns)
        event["hold_back_ns"] = decision.hold_back_ns
        event["bit"], event["copy_bit"] = decision.bit, decision.copy_bit

    def departure(self, route: TapRoute, departure: ScheduledDeparture, now_ns: int) -> None:
        """Report the departure of a datagram or a copy."""
        event = self._add(route, not route.reverse, departure.data, now_ns)
        event["flow"], event["packet"] = departure.flow, departure.packet
        event["fate"], event["bit"] = departure.fate, departure.bit
        event["delay_ns"] = now_ns - departure.arrival_ns
        event["copy_delay_ns"] = event["copy_bit"] = -1
        event["departure"] = 1
        event["copy"], event["stale"] = departure.copy, departure.stale

    def report(self) -> None:
        """Pass the collected events to the taps."""
        if self._count:
            data = np.frombuffer(bytes(self._data), np.uint8)
            for tap in self._taps:
                tap.take(self._events[: self._count], data)
            self._events[:] = np.zeros(1, EVENT)
            self._count = 0
            self._data.clear()

    def _add(self, route: TapRoute, server_side: bool, data: bytes, now_ns: int) -> np.void:
        if self._count == _MOST_EVENTS:
            self.report()
        event: np.void = self._events[self._count]
        self._count += 1
        event["t_ns"] = self.unix_ns + now_ns
        event["link"], event["direction"], event["mansd"] = route[:3]
        event["interface"] = 2 * route.link + server_side
        event["size_bytes"], event["offset"] = len(data), len(self._data)
        ends = (route.path, route.server) if server_side else (route.client, route.listen)
        for field, (host, port) in zip(
            ("source", "destination"), ends[::-1] if route.reverse else ends, strict=True
        ):
            address = ipaddress.ip_address(host.partition("%")[0])
            packed = address.packed.ljust(ADDRESS_BYTES, b"\0")
            event[field] = np.frombuffer(packed, np.uint8)
            event[f"{field}_port"] = port
            event["family"] = address.version
        if self._wants_data:
            self._data += data
        return event


def _delay(t_ns: int, now_ns: int) -> int:
    return -1 if t_ns == NEVER_NS else t_ns - now_ns
