"""The network of a run in plain Python: datagrams in, surviving datagrams out, maybe later.

The core decides for each packet (native/network/link.c): this is no independent statement of the decisions.
:mod:`tests.oracles.loss_decisions` has one of losses, :mod:`tests.oracles.loss_language` one of the
guarantee. Independent of native/network/channel.c is here what follows from the decisions: rows, copies,
flipped bits, the queue of a rate that chooses, and the order of departures.
"""

import heapq
import math
from collections.abc import Sequence
from fractions import Fraction
from typing import Any, NamedTuple, TypeVar

import numpy as np

from netem.channel import UPDATE_LINK, Datagram, due_settings, link_name
from netem.link_state import LinkState
from noack.core.core_library import core
from noack.impairments.disciplines.earliest_deadline import EarliestDeadline
from noack.impairments.disciplines.maximum_error import MaximumError
from noack.impairments.disciplines.priority import Priority
from noack.impairments.kinds.rate import Rate
from noack.impairments.link_settings import Counters, Decisions, LinkSettings
from noack.protocol.record_tables import NETEM_PACKET, NETEM_RELEASE, NETEM_SETTING, PACKET_HEAD_BYTES, Fate
from noack.protocol.roles import Notice, Record
from noack.scenario.parameter_changes import ChangeSchedule, ParameterChange
from noack.scenario.scenario import Scenario
from tests.helpers.machine_parts import Machine


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


class _Waiting(NamedTuple):
    """A datagram that waits until the link is free; of the flow with the smallest key, the oldest one
    leaves first."""

    key: int
    number: int
    entry_ns: int
    after_ns: int
    """The constant delays."""
    leaving: _InFlight


T = TypeVar("T", bound=Any)


class Link:
    """The machine of the network emulator.

    Args:
        settings: the settings; they must not name files.
        seed: seed of its random streams.
        name: names of the link and the direction; part of its random streams' names.
        decisions: recorded decisions per flow; each flow repeats them before the settings apply.
        schedule: announced changes of the settings; None: nothing can be announced.
        loops: loops of a run, whose numbers are their rows; 0: rows in the order of first packets.
    """

    def __init__(
        self,
        settings: LinkSettings,
        seed: int,
        *name: str,
        decisions: Decisions = (),
        schedule: ChangeSchedule | None = None,
        loops: int = 0,
    ) -> None:
        self._loops = loops
        self._state = LinkState(settings, seed, *name, decisions=decisions)
        self._schedule = schedule
        self._reached_ns = -1
        self._rows: dict[int, int] = {}
        self._in_flight: list[_InFlight] = []
        self._put_in_flight = 0
        self._waiting: list[_Waiting] = []
        self._free = Fraction(0)
        self._inputs = 0

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
        """Apply other settings; see native/network/link_change.c."""
        self._serve(math.inf)
        latest_ns = np.full(self._state.rows, core.NOACK_NEVER_NS, np.int64)
        for leaving in self._in_flight:
            row = self._rows[leaving.datagram.flow]
            latest_ns[row] = max(latest_ns[row], leaving.release_ns)
        self._state.change(settings, latest_ns)
        if (rate := _scheduler(settings)) is not None:
            queue = self._queue
            self._free = queue.busy_until_ns + Fraction(queue.carry, rate.rate_bps)

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
            self._inputs, due.packet, due.release_ns, now_ns,
            due.datagram.flow, int(due.copy), int(stale),
        )  # fmt: skip
        self._inputs += 1
        self._serve(due.release_ns)
        return (due.datagram, Record(NETEM_RELEASE, row))

    def handle(self, message: Datagram, now_ns: int) -> Sequence[Datagram | Record | Notice]:
        """Process a datagram; return it if it is neither lost nor delayed."""
        self.reach(now_ns)
        self._serve(now_ns)
        decision = self.decide(message.flow, len(message.data), now_ns)
        head = message.data[:PACKET_HEAD_BYTES].ljust(PACKET_HEAD_BYTES, b"\0")
        row = (
            self._inputs, decision.packet, now_ns, now_ns,
            message.flow, Fate(decision.fate), decision.consecutive_losses,
            decision.release_ns, decision.copy_ns, decision.bit, len(message.data), head,
        )  # fmt: skip
        self._inputs += 1
        record = Record(NETEM_PACKET, row)
        if decision.release_ns == core.NOACK_NEVER_NS:
            return (record,)
        leaving = self._release(message, decision.release_ns, decision.bit, copy=False)
        if decision.copy_ns != core.NOACK_NEVER_NS:
            leaving += self._release(message, decision.copy_ns, decision.copy_bit, copy=True)
        self._serve(now_ns)
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
            row = self._rows[flow] = flow % self._loops if self._loops else len(self._rows)
            self._state.start_flow(row, flow)
        return self._state.decide(row, size_bytes, now_ns)

    def _release(self, message: Datagram, release_ns: int, bit: int, *, copy: bool) -> tuple[Datagram, ...]:
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
        if decision.waits:
            rate, row, entry_ns = (
                _scheduler(self._state.settings),
                self._rows[message.flow],
                self._queue.entry_ns,
            )
            assert rate is not None
            key = rate.discipline.numbers[min(row, len(rate.discipline.numbers) - 1)]
            if isinstance(rate.discipline, EarliestDeadline):
                key += entry_ns
            if isinstance(rate.discipline, MaximumError) and _is_update(message.data):
                key -= message.data[5]
            self._waiting.append(_Waiting(key, leaving.number, entry_ns, decision.after_ns, leaving))
            self._queue.waiting_count = len(self._waiting)
            return ()
        # Overdue datagrams leave first, even if ``on_timer`` has not been called for them yet.
        overdue = bool(self._in_flight) and self._in_flight[0].release_ns <= release_ns
        if leaving.delayed or overdue:
            heapq.heappush(self._in_flight, leaving)
            return ()
        self._leave(leaving)
        return (message,)

    def _serve(self, until_ns: float) -> None:
        """Begin to send what can begin until then: of what waits, the smallest."""
        while self._waiting and (int(self._free) <= until_ns or len(self._waiting) == self.in_flight):
            first = min(self._waiting, key=lambda waiting: (self._flow_key(waiting), waiting.number))
            self._waiting.remove(first)
            rate = _scheduler(self._state.settings)
            assert rate is not None
            begin = self._free if int(self._free) >= first.entry_ns else Fraction(first.entry_ns)
            flow, size_bytes = first.leaving.datagram.flow, len(first.leaving.datagram.data)
            bits = int(rate.line_bits(size_bytes))
            self._free = begin + Fraction(bits * 10**9, rate.rate_bps)
            link = self._state.core  # it knows how many wait, and until when the link is busy
            self._queue.waiting_count = len(self._waiting)
            assert core.noack_queue_serve(link, link.scheduler, size_bytes) == int(self._free)
            leaves_ns = max(
                int(self._free) + first.after_ns, first.leaving.release_ns, self.flow(flow).first_release_ns
            )
            self.flow(flow).first_release_ns = leaves_ns
            heapq.heappush(self._in_flight, first.leaving._replace(release_ns=leaves_ns))

    def _flow_key(self, waiting: _Waiting) -> int:
        """The smallest key of what waits of the same flow."""
        flow = waiting.leaving.datagram.flow
        return min(other.key for other in self._waiting if other.leaving.datagram.flow == flow)

    @property
    def _queue(self) -> Any:
        """The state of the queue that chooses, a ``noack_queue``."""
        return self._state.core.queues[self._state.core.scheduler]

    def _leave(self, leaving: _InFlight) -> bool:
        row, size_bytes = self._rows[leaving.datagram.flow], len(leaving.datagram.data)
        return self._state.leave(
            row, leaving.packet, size_bytes, delayed=leaving.delayed, counts=leaving.counts
        )


def _scheduler(settings: LinkSettings) -> Any:
    """The rate that chooses what it sends; None: there is none."""
    rates = [impairment for impairment in settings.impairments if isinstance(impairment, Rate)]
    chosen = [
        rate for rate in rates if isinstance(rate.discipline, Priority | EarliestDeadline | MaximumError)
    ]
    return chosen[0] if chosen else None


def _is_update(data: bytes) -> bool:
    return len(data) >= 32 and data[:2] == b"NA" and data[2] in (1, 2) and data[3] == 2


def update_link_of(resolved: Scenario) -> Link:
    """Return the link from sensor to controller of a resolved scenario."""
    schedule = ChangeSchedule(resolved, lambda scenario: scenario.network.link)
    return Link(resolved.network.link, resolved.seeds.loss, UPDATE_LINK, schedule=schedule)


class Duplex:
    """The machine of a network with a direction from the controller.

    If the forward direction is a link with a schedule of changes, its settings may change.
    """

    def __init__(
        self,
        forward: Machine[Datagram],
        reverse: Machine[Datagram],
        *,
        loops: int = 1,
    ) -> None:
        self._links = (forward, reverse)
        self._loops = loops
        self._inputs = 0

    def announce(self, change: ParameterChange, now_ns: int) -> Sequence[Record | Notice]:
        """Accept a change of the forward direction; see :class:`Link`."""
        forward = self._links[0]
        assert isinstance(forward, Link)
        return self._numbered(forward.announce(change, now_ns))

    def next_deadline_ns(self) -> int | None:
        """Time of the next departure in either direction; None: nothing is in flight."""
        due = (link.next_deadline_ns() for link in self._links)
        return min((t_ns for t_ns in due if t_ns is not None), default=None)

    def on_timer(self, now_ns: int) -> Sequence[Datagram | Record | Notice]:
        """Forward the datagram that is due; if one is due in each direction, the forward one."""
        next_ns = self.next_deadline_ns()
        link = next(link for link in self._links if link.next_deadline_ns() == next_ns)
        return self._numbered(link.on_timer(now_ns))

    def handle(self, message: Datagram, now_ns: int) -> Sequence[Datagram | Record | Notice]:
        """Process a datagram; return it if it is neither lost nor delayed."""
        if not 0 <= message.flow < 2 * self._loops:
            raise ValueError(f"a network of two directions has no flow {message.flow}")
        if isinstance(forward := self._links[0], Link):
            forward.reach(now_ns)  # a change is due for both directions at the same datagram
        return self._numbered(self._links[message.flow // self._loops].handle(message, now_ns))

    def _numbered(self, outputs: Sequence[T]) -> list[T]:
        """Number the inputs of both directions in one sequence; an input produces one row."""
        number, self._inputs = self._inputs, self._inputs + 1
        return [
            output._replace(row=(number, *output.row[1:])) if isinstance(output, Record) else output
            for output in outputs
        ]


def network_of(
    resolved: Scenario,
    forward: Machine[Datagram] | None = None,
    loops: int = 1,
) -> Machine[Datagram]:
    """Return the network of a resolved scenario; ``forward`` replaces the link of the updates."""
    forward = update_link_of(resolved) if forward is None else forward
    _, *others = resolved.network.flows
    if not others:
        return forward
    settings, name = resolved.network.link_of(others[0]), link_name(others[0])
    reverse = Link(settings, resolved.seeds.loss, name)
    return Duplex(forward, reverse, loops=loops)


def flipped(data: bytes, bit: int) -> bytes:
    """The data with one bit flipped; bit 0 is the least significant bit of byte 0; -1: none."""
    if bit < 0:
        return data
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << (bit % 8)
    return bytes(changed)
