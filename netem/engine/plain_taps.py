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


class TapEndpoints(NamedTuple):
    """The addresses between which a client's datagrams are sent."""

    client: Address
    listen: Address
    path: Address
    """The client's return path."""
    server: Address


class TapDirection(NamedTuple):
    """A direction of a link."""

    link: int
    back: bool
    mansd: int


class PlainTaps:
    """Taps, and the events that have not been passed to them yet.

    Args:
        taps: the taps.
    """

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
        self,
        way: TapDirection,
        ends: TapEndpoints,
        flow: int,
        data: bytes,
        verdict: PacketDecision,
        now_ns: int,
    ) -> None:
        """Report the arrival of a datagram and the decision."""
        event = self._add(way, ends, way.back, data, now_ns)
        event["flow"], event["packet"], event["fate"] = flow, verdict.packet, verdict.fate
        event["consecutive_losses"] = verdict.consecutive_losses
        event["delay_ns"] = _delay(verdict.release_ns, now_ns)
        event["copy_delay_ns"] = _delay(verdict.copy_ns, now_ns)
        event["hold_back_ns"] = verdict.hold_back_ns
        event["bit"], event["copy_bit"] = verdict.bit, verdict.copy_bit
        event["departure"] = 0

    def departure(
        self, way: TapDirection, ends: TapEndpoints, departure: ScheduledDeparture, now_ns: int
    ) -> None:
        """Report the departure of a datagram or a copy."""
        event = self._add(way, ends, not way.back, departure.data, now_ns)
        event["flow"], event["packet"] = departure.flow, departure.packet
        event["fate"] = departure.fate
        event["delay_ns"] = now_ns - departure.arrival_ns
        event["copy_delay_ns"] = event["copy_bit"] = -1
        event["consecutive_losses"] = event["hold_back_ns"] = 0
        event["bit"] = departure.bit
        event["departure"] = 1
        event["copy"], event["stale"] = departure.copy, departure.stale

    def tell(self) -> None:
        """Pass the collected events to the taps."""
        if self._count:
            data = np.frombuffer(bytes(self._data), np.uint8)
            for tap in self._taps:
                tap.take(self._events[: self._count], data)
            self._events[:] = np.zeros(1, EVENT)
            self._count = 0
            self._data.clear()

    def _add(
        self, way: TapDirection, ends: TapEndpoints, server_side: bool, data: bytes, now_ns: int
    ) -> np.void:
        if self._count == _MOST:
            self.tell()
        event: np.void = self._events[self._count]
        self._count += 1
        event["t_ns"] = self.unix_ns + now_ns
        event["link"], event["direction"], event["mansd"] = way.link, way.back, way.mansd
        event["interface"] = 2 * way.link + server_side
        event["size_bytes"] = len(data)
        event["offset"] = len(self._data)
        near, far = (ends.path, ends.server) if server_side else (ends.client, ends.listen)
        for field, (host, port) in zip(
            ("source", "destination"), (far, near) if way.back else (near, far), strict=True
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
