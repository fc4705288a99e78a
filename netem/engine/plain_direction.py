"""One direction of a link in the portable engine: the machine and its counters."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from netem.engine.histogram import bucket_of, empty
from netem.engine.relay_interface import Direction, DirectionReport, FlowReport, LinkSpec
from netem.link_machine import Datagram, Link
from noack.impairments.link_records import PacketDecision
from noack.impairments.link_settings import LinkSettings
from noack.protocol.machine_interface import Record
from noack.protocol.record_tables import NETEM_RELEASE


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
    ) -> tuple[PacketDecision, Sequence[ScheduledDeparture]]:
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
