"""One direction of a link as a state machine: datagrams in, surviving datagrams out, maybe later.

It does not interpret payloads. The core decides (native/link.c): in a run of the loop, in
simulation, in replay, and in the relay.
"""

import heapq
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from netem.link_state import LinkState
from noack.config.parameter_changes import ChangeSchedule, ParameterChange
from noack.config.scenario import Scenario
from noack.impairments.link_records import NEVER_NS, Counters, RecordedDecision
from noack.impairments.link_settings import LinkSettings
from noack.protocol.machine_interface import BEGINNING, Notice, Record, Start
from noack.protocol.record_tables import (
    NETEM_PACKET,
    NETEM_RELEASE,
    NETEM_SETTING,
    PACKET_HEAD_BYTES,
    Fate,
)
from noack.protocol.wire_format import Flow


def link_name(flow: Flow) -> str:
    """Return the name of the link of a flow; part of its random streams' names."""
    return flow.name.lower()


UPDATE_LINK = link_name(Flow.UPDATE)


class Datagram(NamedTuple):
    """A datagram of a flow; flows are numbered in the order of their first datagrams."""

    flow: int
    data: bytes
    arrival_ns: int = 2**62
    """Arrival at the socket, for the record; later than its handling: unknown."""


class _InFlight(NamedTuple):
    """A delayed datagram or copy; at equal times, datagrams leave in their order of arrival."""

    release_ns: int
    number: int
    packet: int
    copy: bool
    counts: bool
    """Whether it is the datagram's first intact copy."""
    delayed: bool
    datagram: Datagram


class Link:
    """The machine of the network emulator.

    Args:
        settings: the settings; they must not name files.
        seed: seed of its random streams.
        name: names of the link and the direction; part of its random streams' names.
        decisions: recorded decisions per flow; each flow repeats them before the settings apply.
        first_number: number of the first input and of the first packet.
        schedule: announced changes of the settings; None: nothing can be announced.
        restarted: the link has replaced another in a run; see
            :class:`netem.link_state.LinkState`.
    """

    def __init__(
        self,
        settings: LinkSettings,
        seed: int,
        *name: str,
        decisions: Sequence[Sequence[RecordedDecision]] = (),
        first_number: int = 0,
        schedule: ChangeSchedule | None = None,
        restarted: bool = False,
    ) -> None:
        self._state = LinkState(settings, seed, *name, decisions=decisions, restarted=restarted)
        self._schedule = schedule
        self._reached_ns = -1
        self._rows: dict[int, int] = {}
        self._in_flight: list[_InFlight] = []
        self._put_in_flight = 0
        self._inputs = self._first_number = first_number

    @property
    def counters(self) -> Counters:
        """Counts so far."""
        return self._state.counters

    @property
    def decision(self) -> Any:
        """The decision for the last datagram, a ``noack_decision``; overwritten by the next."""
        return self._state.decision

    @property
    def in_flight(self) -> int:
        """Number of datagrams and copies in flight."""
        return int(self._state.core.in_flight)

    def flow(self, flow: int) -> Any:
        """The state of a flow, a ``noack_flow``; None if none of its datagrams has arrived."""
        row = self._rows.get(flow)
        return None if row is None else self._state.flow(row)

    def change(self, settings: LinkSettings) -> None:
        """Apply other settings; see native/link_change.c."""
        latest_ns = np.full(self._state.rows, NEVER_NS, np.int64)
        for leaving in self._in_flight:
            row = self._rows[leaving.datagram.flow]
            latest_ns[row] = max(latest_ns[row], leaving.release_ns)
        self._state.change(settings, latest_ns)

    def announce(self, change: ParameterChange, now_ns: int) -> Sequence[Record | Notice]:
        """Accept a change; it applies from the first datagram that arrives at or after its time T.

        A smaller cap applies from that datagram on: if the number of consecutive losses before it
        has reached the new cap, the datagram passes. Hence a loss burst is never longer than the
        largest cap that applied during it.
        """
        assert self._schedule is not None
        number, self._inputs = self._inputs, self._inputs + 1
        return self._schedule.announce(NETEM_SETTING, change, number, now_ns, self._reached_ns)

    def next_deadline_ns(self) -> int | None:
        """Time of the next departure; None: nothing is in flight."""
        return self._in_flight[0].release_ns if self._in_flight else None

    def on_timer(self, now_ns: int) -> Sequence[Datagram | Record | Notice]:
        """Forward the datagram that is due."""
        due = heapq.heappop(self._in_flight)
        stale = self._leave(due)
        row = (
            self._inputs, self._first_number + due.packet, due.release_ns, now_ns,
            due.datagram.flow, int(due.copy), int(stale),
        )  # fmt: skip
        self._inputs += 1
        return (due.datagram, Record(NETEM_RELEASE, row))

    def handle(self, message: Datagram, now_ns: int) -> Sequence[Datagram | Record | Notice]:
        """Process a datagram; return it if it is neither lost nor delayed."""
        self.reach(now_ns)
        decision = self.decide(message.flow, len(message.data), now_ns)
        head = message.data[:PACKET_HEAD_BYTES].ljust(PACKET_HEAD_BYTES, b"\0")
        row = (
            self._inputs, self._first_number + decision.packet, min(message.arrival_ns, now_ns),
            now_ns, message.flow, Fate(decision.fate), decision.consecutive_losses,
            decision.release_ns, decision.copy_ns, decision.bit, len(message.data), head,
        )  # fmt: skip
        self._inputs += 1
        record = Record(NETEM_PACKET, row)
        if decision.release_ns == NEVER_NS:
            return (record,)
        leaving = self._release(message, decision.release_ns, decision.bit, copy=False)
        if decision.copy_ns != NEVER_NS:
            leaving += self._release(message, decision.copy_ns, decision.copy_bit, copy=True)
        return (*leaving, record)

    def reach(self, now_ns: int) -> None:
        """Apply the changes that are due before a datagram of this time."""
        if self._schedule is not None:
            for settings in due_settings(self._schedule, self._state.settings, now_ns):
                self.change(settings)
            self._reached_ns = now_ns

    def decide(self, flow: int, size_bytes: int, now_ns: int) -> Any:
        """Decide for a flow's next packet; the next call overwrites the ``noack_decision``."""
        row = self._rows.get(flow)
        if row is None:
            row = self._rows[flow] = len(self._rows)
            self._state.start_flow(row, flow)
        return self._state.decide(row, size_bytes, now_ns)

    def _release(
        self, message: Datagram, release_ns: int, bit: int, *, copy: bool
    ) -> tuple[Datagram, ...]:
        """Return a datagram that leaves at once, or keep it until it is due."""
        decision = self.decision
        counts = bit < 0 and not (copy and decision.bit < 0)
        if bit >= 0:
            message = message._replace(data=flipped(message.data, bit))
        self._put_in_flight += 1
        leaving = _InFlight(
            release_ns, self._put_in_flight, decision.packet, copy, counts,
            release_ns > decision.arrival_ns, message,
        )  # fmt: skip
        # Overdue datagrams leave first, even if ``on_timer`` has not been called for them yet.
        overdue = bool(self._in_flight) and self._in_flight[0].release_ns <= release_ns
        if leaving.delayed or overdue:
            heapq.heappush(self._in_flight, leaving)
            return ()
        self._leave(leaving)
        return (message,)

    def _leave(self, leaving: _InFlight) -> bool:
        row, size_bytes = self._rows[leaving.datagram.flow], len(leaving.datagram.data)
        return self._state.leave(
            row, leaving.packet, size_bytes, delayed=leaving.delayed, counts=leaving.counts
        )


def flipped(data: bytes, bit: int) -> bytes:
    """Return the data with one bit flipped; bit 0 is the least significant bit of byte 0."""
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << (bit % 8)
    return bytes(changed)


def update_link_of(resolved: Scenario, start: Start = BEGINNING) -> Link:
    """Return the link from sensor to controller of a resolved scenario."""
    schedule = ChangeSchedule(resolved, lambda one: one.network.link)
    return link_of(resolved.network.link, resolved.seeds.loss, UPDATE_LINK, start, schedule)


def link_of(
    settings: LinkSettings, seed: int, name: str, start: Start,
    schedule: ChangeSchedule | None = None,
) -> Link:  # fmt: skip
    """Return a link of a run."""
    settings, names = at_start(settings, name, start)
    return Link(
        settings, seed, *names, first_number=start.first_number, schedule=schedule,
        restarted=start.is_restart,
    )  # fmt: skip


def at_start(settings: LinkSettings, name: str, start: Start) -> tuple[LinkSettings, list[str]]:
    """Return the settings of a link of a run, and the names of its random streams.

    A restarted emulator does not know the losses before. Therefore its first datagrams pass
    (see :class:`netem.link_state.LinkState`), and later ones are drawn from other random streams
    than before.
    """
    if not start.is_restart:
        return settings, [name]
    settings = settings.model_copy(update={"first_delivered": True})
    return settings, [name, f"again-{start.generation}"]


def due_settings(
    schedule: ChangeSchedule, present: LinkSettings, now_ns: int
) -> Iterator[LinkSettings]:
    """Yield the settings that replace the present ones before a datagram that arrives now."""
    while (change := schedule.take(now_ns)) is not None:
        first = present.first_delivered  # a restarted emulator has its own value
        settings = change.prepared.model_copy(update={"first_delivered": first})
        if settings != present:
            present = settings
            yield settings
