"""The events that the portable engine reports to taps."""

import ipaddress
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from netem.engine.plain_direction import ScheduledDeparture
from netem.engine.relay_interface import Address, Tap
from netem.relay_events import ADDRESS_BYTES, EVENT
from noack.impairments.link_records import NEVER_NS, PacketDecision

_MOST = 512


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
        self._events = np.zeros(_MOST, EVENT)
        self._count = 0
        self.unix_ns = 0
        """Unix time at which the relay started to run."""

    def __bool__(self) -> bool:
        return bool(self._taps)

    def arrival(
        self, route: TapRoute, flow: int, data: bytes, decision: PacketDecision, now_ns: int
    ) -> None:
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
        if self._count == _MOST:
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
