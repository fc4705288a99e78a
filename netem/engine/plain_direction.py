"""One direction of a link in the portable engine: the machine and its counters."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

from netem.engine.histogram import bucket_of, empty
from netem.engine.relay_interface import Direction, DirectionReport, FlowReport, LinkSpec
from netem.engine.unintended_losses import UnintendedLosses
from netem.link_machine import Datagram, Link
from noack.impairments.link_records import PacketDecision
from noack.impairments.link_settings import LinkSettings
from noack.protocol.machine_interface import Notice, Record
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
    stale: bool


class _Kept(NamedTuple):
    """A datagram that is in flight, or whose copy is."""

    arrival_ns: int
    fate: int
    bits: tuple[int, int]
    """Flipped bits of the datagram and of its copy."""
    left: int
    """Number of these two that are still in flight."""


class PlainDirection:
    """One direction of a link.

    Args:
        spec: the link.
        direction: forward or reverse.
        settings: the settings.
    """

    def __init__(self, spec: LinkSpec, direction: Direction, settings: LinkSettings) -> None:
        self.settings = settings
        decisions = spec.decisions.get(direction, ())
        self.link = Link(settings, spec.seed, spec.name, direction, decisions=decisions)
        self.losses = UnintendedLosses(spec.name, direction)
        self.errors: Counter[int] = Counter()
        """Number of datagrams that could not be sent or stored, by errno."""
        self._delays, self._lateness = empty(), empty()
        self._kept: dict[tuple[int, int], _Kept] = {}

    def admit(
        self, flow: int, data: bytes, now_ns: int
    ) -> tuple[PacketDecision, Sequence[ScheduledDeparture]]:
        """Decide for a datagram; return the departures that are due at once."""
        outputs = self.link.handle(Datagram(flow, data), now_ns)
        decision = self.link.decision
        times_ns = (decision.release_ns, decision.copy_ns)
        bits = (decision.bit, decision.copy_bit)
        left = sum(t_ns > now_ns for t_ns in times_ns)
        if left:
            self._kept[flow, decision.packet] = _Kept(now_ns, decision.fate, bits, left)
        now = [which for which in range(2) if times_ns[which] == now_ns]
        datagrams = [output for output in outputs if isinstance(output, Datagram)]
        return decision, [
            ScheduledDeparture(
                flow, datagram.data, decision.packet, decision.fate, now_ns, now_ns, bits[which],
                delayed=False, copy=which == 1, stale=False,
            )
            for which, datagram in zip(now, datagrams, strict=True)
        ]  # fmt: skip

    def due(self, now_ns: int) -> Iterator[ScheduledDeparture]:
        """Yield the departures that are due, one by one."""
        while (deadline_ns := self.link.next_deadline_ns()) is not None and deadline_ns <= now_ns:
            yield self._departure(self.link.on_timer(now_ns))

    def sent(self, departure: ScheduledDeparture, now_ns: int) -> None:
        """Record that a datagram was sent."""
        self._delays[bucket_of(now_ns - departure.arrival_ns)] += 1
        if departure.delayed:
            self._lateness[bucket_of(now_ns - departure.release_ns)] += 1

    def change(self, settings: LinkSettings) -> None:
        """Apply other settings."""
        self.settings = settings
        self.link.change(settings)

    def report(self, flows: Sequence[FlowReport]) -> DirectionReport:
        """Return the counts so far."""
        for error, datagrams in self.errors.items():
            self.losses.not_sent(error, datagrams)
        return DirectionReport(
            settings=self.settings,
            counters=replace(self.link.counters),
            unintended=self.losses.counts(),
            in_flight=self.link.in_flight,
            flows=flows,
            delays=self._delays.copy(),
            lateness=self._lateness.copy(),
        )

    def _departure(self, outputs: Sequence[Datagram | Record | Notice]) -> ScheduledDeparture:
        datagram, record = outputs
        if not isinstance(datagram, Datagram) or not isinstance(record, Record):
            raise TypeError(f"not what a {NETEM_RELEASE} comes with: {outputs}")
        _, packet, release_ns, _, flow, copy, stale = record.row
        kept = self._kept.pop((flow, packet))
        if kept.left > 1:
            self._kept[flow, packet] = kept._replace(left=kept.left - 1)
        return ScheduledDeparture(
            flow, datagram.data, packet, kept.fate, kept.arrival_ns, release_ns, kept.bits[copy],
            delayed=True, copy=bool(copy), stale=bool(stale),
        )  # fmt: skip
