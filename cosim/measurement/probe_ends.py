"""The two ends of a live probe, without clocks: what to send when, and what was received.

Deadlines are absolute: a late datagram is sent late, and none is left out. The sender of a
round-trip probe also takes the answers.
"""

from array import array
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.clock import NS_PER_S
from noack.protocol.probe_format import (
    MAX_PROBES,
    PROBE_BYTES,
    SEEN_BITS,
    ProbeDatagram,
    ProbeKind,
    decode_probe,
    encode_probe,
)
from noack.traces.packet_trace import LOST_NS, PacketTrace, packet_trace, relative_delays


class ProbeResult(NamedTuple):
    """The result at one end."""

    trace: PacketTrace | None
    """None at the sender of a one-way probe, which cannot know what arrived."""
    notes: Sequence[str]
    """Lines for the report."""
    kernel_drops: int | None
    """Datagrams that arrived at this host, and were dropped by its kernel because this process
    did not read them in time; None if the system does not count them."""


_REASONS = {
    "foreign": "not of this program",
    "version": "of another version of this program",
    "corrupted": "corrupted on the way",
    "impossible": "with impossible content",
    "ahead of schedule": "with a sequence number ahead of the schedule",
    "other session": "of another probe",
    "duplicate": "duplicates",
}


def ignored_lines(ignored: Mapping[str, int]) -> list[str]:
    """Return a line about the ignored datagrams; none if there are none."""
    parts = [f"{count} {_REASONS[reason]}" for reason, count in ignored.items() if count]
    return [f"ignored datagrams: {', '.join(parts)}"] if parts else []


def late_sends(sent: int, late: int, longest_ns: int) -> str:
    """Return a line about the sender's punctuality."""
    text = f"datagrams sent: {sent}; late sends: {late}"
    return f"{text}, the longest by {longest_ns / 1e6:.3g} ms" if late else text


_ENDS = 20
"""Number of times that END is sent; some may be lost."""
_END_PERIOD_NS = NS_PER_S // 10
_LATE_NS = 1_000_000
"""A datagram that leaves later than this after its time is reported."""
_FORWARD, _REVERSE, _UNKNOWN = "forward", "reverse", "unknown"
_ANSWERS_AT_ONCE = 10_000


class ProbePlan(NamedTuple):
    """What the user asked for."""

    period_ns: int
    planned: int
    """Number of datagrams."""
    size_bytes: int = PROBE_BYTES
    is_round_trip: bool = False
    wait_ns: int = 3 * NS_PER_S
    """How long a round-trip probe waits for answers after its last datagram."""


class ProbeSender:
    """Sends one session, then END several times.

    Args:
        plan: what to send.
        session: a random number.
        host: number of this machine since its last boot; 0 if it is unknown.
        start_ns: when the first datagram is sent.
        rows: takes the rows of the raw trace.
    """

    def __init__(
        self,
        plan: ProbePlan,
        session: int,
        host: int,
        start_ns: int,
        rows: Callable[..., None] = lambda *values: None,
    ) -> None:
        self._plan, self._rows = plan, rows
        self._kind = ProbeKind.REQUEST if plan.is_round_trip else ProbeKind.PROBE
        self._content = ProbeDatagram(self._kind, session, host, 0, 0, start_ns, plan.period_ns, plan.planned)
        self._sent_ns, self._received_ns = array("q"), array("q")
        self._to_send = plan.planned
        self._late_sends = self._longest_late_ns = 0
        self._late_ns = min(_LATE_NS, plan.period_ns)
        self.ends = 0
        """Number of END datagrams sent so far."""
        self._ended_ns = 0
        self._all_answers: int | None = None
        self._numbers, self._newest, self._seen = array("Q"), array("Q"), bytearray()
        self._ignored: Counter[str] = Counter()
        rows(
            *(
                ["sequence", "sent_ns", "received_ns", "lost"]
                if plan.is_round_trip
                else ["sequence", "sent_ns", "late_ns"]
            )
        )

    @property
    def sent(self) -> int:
        """Number of datagrams sent so far."""
        return len(self._sent_ns)

    def next_deadline_ns(self) -> int:
        """Return when :meth:`on_timer` is due."""
        if self.sent < self._to_send:
            return self._content.scheduled_ns(self.sent)
        return self._ended_ns + self.ends * _END_PERIOD_NS

    def on_timer(self, now_ns: int) -> bytes:
        """Return the datagram that is due; ``now_ns`` becomes its time of sending."""
        if self.sent >= self._to_send:
            self.ends += 1
            end = self._content._replace(
                kind=ProbeKind.END,
                sequence=self.sent,
                sent_ns=now_ns,
                planned=self._to_send,
                number=self._late_sends,
                newest=self._longest_late_ns,
            )
            return encode_probe(end, self._plan.size_bytes)
        late_ns = now_ns - self.next_deadline_ns()
        if late_ns > self._late_ns:
            self._late_sends += 1
            self._longest_late_ns = max(self._longest_late_ns, late_ns)
        probe = self._content._replace(sequence=self.sent, sent_ns=now_ns)
        if not self._plan.is_round_trip:
            self._rows(self.sent, now_ns, late_ns)
        self._sent_ns.append(now_ns)
        self._received_ns.append(LOST_NS)
        if self.sent == self._to_send:
            self._ended_ns = now_ns
        return encode_probe(probe, self._plan.size_bytes)

    def stop(self, now_ns: int) -> None:
        """Send no more datagrams, only END."""
        if self.sent < self._to_send:
            self._to_send, self._ended_ns = self.sent, now_ns

    def handle(self, data: bytes, received_ns: int) -> None:
        """Take a datagram that came back."""
        try:
            content = decode_probe(data)
        except ValueError as error:
            self._ignored[str(error)] += 1
            return
        sequence = content.sequence
        if content.session != self._content.session:
            self._ignored["other session"] += 1
        elif content.kind is ProbeKind.END_ANSWER:
            self._all_answers = content.number
        elif content.kind is not ProbeKind.ANSWER or sequence >= self.sent:
            self._ignored["impossible"] += 1
        elif self._received_ns[sequence] != LOST_NS:
            self._ignored["duplicate"] += 1
        else:
            self._received_ns[sequence] = received_ns
            self._rows(sequence, self._sent_ns[sequence], received_ns, "")
            self._numbers.append(content.number)
            self._newest.append(content.newest)
            self._seen += content.seen.to_bytes(SEEN_BITS // 8, "little")

    def is_over(self, now_ns: int) -> bool:
        """Whether there is nothing more to send or to wait for."""
        if self.sent < self._to_send:
            return False
        if not self._plan.is_round_trip:
            return self.ends >= _ENDS
        complete = self._all_answers is not None and len(self._numbers) >= self.sent
        return complete or now_ns > self._ended_ns + max(self._plan.wait_ns, 0)

    def finish(self, kernel_drops: int | None) -> ProbeResult:
        """Return what is known at this end."""
        notes = [late_sends(self.sent, self._late_sends, self._longest_late_ns)]
        if not self._plan.is_round_trip or not self.sent:
            return ProbeResult(None, tuple(notes), kernel_drops)
        sent_ns, received_ns = np.array(self._sent_ns), np.array(self._received_ns)
        lost = received_ns == LOST_NS
        directions = self.lost_directions()
        for sequence, direction in directions.items():
            self._rows(sequence, self._sent_ns[sequence], "", direction)
        notes.append(self._losses_by_direction(list(directions.values())))
        notes += ignored_lines(self._ignored)
        return ProbeResult(packet_trace(sent_ns, received_ns, lost), tuple(notes), kernel_drops)

    def lost_directions(self) -> dict[int, str]:
        """Return in which direction each datagram without an answer was lost.

        Each answer has the newest sequence number that had arrived, and which of the 128 up to it.
        A number that no answer covers was lost in an unknown direction.
        """
        arrived, covered = self._arrivals()
        lost = np.flatnonzero(np.array(self._received_ns) == LOST_NS)
        directions = np.where(covered, _FORWARD, _UNKNOWN)
        directions[arrived] = _REVERSE
        return {int(k): str(directions[k]) for k in lost}

    def _arrivals(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return which numbers the answers show as arrived, and which they cover."""
        arrived, covered = np.zeros(self.sent, bool), np.zeros(self.sent, bool)
        seen = np.frombuffer(bytes(self._seen), np.uint8).reshape(-1, SEEN_BITS // 8)
        for begin in range(0, len(seen), _ANSWERS_AT_ONCE):
            batch = slice(begin, begin + _ANSWERS_AT_ONCE)
            bits = np.unpackbits(seen[batch], axis=1, bitorder="little").astype(bool)
            newest = np.array(self._newest[batch]).astype(np.int64)
            numbers = newest[:, None] - np.arange(SEEN_BITS)
            inside = (numbers >= 0) & (numbers < self.sent)
            covered[numbers[inside]] = True
            arrived[numbers[inside & bits]] = True
        return arrived, covered

    def _losses_by_direction(self, directions: list[str]) -> str:
        counts = Counter(directions)
        text = f"lost forward: {counts[_FORWARD]}; lost in reverse: {counts[_REVERSE]}"
        if not counts[_UNKNOWN]:
            return text
        answers = self._all_answers
        if answers is None:
            answers = max(self._numbers, default=-1) + 1
        reverse = min(max(answers - len(self._numbers) - counts[_REVERSE], 0), counts[_UNKNOWN])
        return (
            f"{text}; lost in an unknown direction: {counts[_UNKNOWN]}, "
            f"of which at least {reverse} in reverse by the numbers of the answers"
        )


_AFTER_END_NS = 2 * NS_PER_S
_AFTER_SCHEDULE_NS = 5 * NS_PER_S
_AHEAD_NS = 60 * NS_PER_S
"""How far ahead of its schedule a sequence number may be: covers the delay of the first."""

Rows = Callable[..., None]
"""Takes the values of a row of the raw trace; the first row has the columns' names."""


class ProbeReceiver:
    """Receives one session: that of the first datagram.

    Args:
        host: number of this machine since its last boot; 0 if it is unknown.
        began_ns: when it began to listen.
        silence_ns: the session is over after this time without a datagram.
        log: takes a line for the user.
        rows: takes the rows of the raw trace.
    """

    def __init__(
        self,
        host: int,
        began_ns: int,
        silence_ns: int,
        log: Callable[[str], None] = lambda line: None,
        rows: Rows = lambda *values: None,
    ) -> None:
        self._host, self._began_ns, self._silence_ns = host, began_ns, silence_ns
        self._log, self._rows = log, rows
        self._first: ProbeDatagram | None = None
        self._end: ProbeDatagram | None = None
        self._first_ns = self._last_ns = self._end_ns = 0
        self._sequence, self._sent_ns, self._received_ns = array("q"), array("q"), array("q")
        self._have = bytearray()
        self._newest = self._answers = self._seen = 0
        self.ignored: Counter[str] = Counter()
        """Datagrams that were ignored, by reason."""

    @property
    def is_same_host(self) -> bool:
        """Whether both ends read the same clock."""
        return self._first is not None and self._host == self._first.host != 0

    def handle(self, data: bytes, source: str, received_ns: int) -> bytes | None:
        """Take a datagram; return the answer to it, if it has one."""
        try:
            content = decode_probe(data)
        except ValueError as error:
            self.ignored[str(error)] += 1
            return None
        kind = content.kind
        if kind not in (ProbeKind.PROBE, ProbeKind.REQUEST, ProbeKind.END):
            self.ignored["impossible"] += 1
            return None
        if self._first is None and kind is not ProbeKind.END:
            self._begin(content, source, received_ns)
        first = self._first
        if first is None or content.session != first.session:
            if first is not None and not self.ignored["other session"]:
                self._log(
                    f"{source}: ignored: another probe is being received; "
                    "a listener receives one probe at a time"
                )
            self.ignored["other session"] += 1
            return None
        if kind is ProbeKind.END:
            if self._end is None:
                self._end, self._end_ns = content, received_ns
            if first.kind is ProbeKind.REQUEST:
                return encode_probe(
                    content._replace(kind=ProbeKind.END_ANSWER, number=self._answers), len(data)
                )
            return None
        return self._take(content, len(data), received_ns)

    def _begin(self, content: ProbeDatagram, source: str, received_ns: int) -> None:
        self._first, self._first_ns = content, received_ns
        clock = "received_ns" if self.is_same_host else "received_other_clock_ns"
        self._rows("sequence", "sent_ns", clock)
        self._newest = content.sequence
        self._log(f"receiving from {source}")

    def _take(self, content: ProbeDatagram, size_bytes: int, received_ns: int) -> bytes | None:
        first = self._first
        assert first is not None
        sequence = content.sequence
        ahead_ns = (sequence - first.sequence) * first.period_ns
        if sequence >= MAX_PROBES or ahead_ns > (received_ns - self._first_ns) + _AHEAD_NS:
            self.ignored["ahead of schedule"] += 1
            return None
        if sequence >= len(self._have):
            self._have.extend(bytes(max(sequence + 1 - len(self._have), len(self._have))))
        if self._have[sequence]:
            self.ignored["duplicate"] += 1
            return None
        self._have[sequence] = 1
        self._last_ns = received_ns
        if self.is_same_host:
            received_ns = max(received_ns, content.sent_ns)  # the kernel's stamp is converted
        self._sequence.append(sequence)
        self._sent_ns.append(content.sent_ns)
        self._received_ns.append(received_ns)
        self._rows(sequence, content.sent_ns, received_ns)
        if first.kind is not ProbeKind.REQUEST:
            return None
        self._note_seen(sequence)
        answer = content._replace(
            kind=ProbeKind.ANSWER, number=self._answers, newest=self._newest, seen=self._seen
        )
        self._answers += 1
        return encode_probe(answer, size_bytes)

    def _note_seen(self, sequence: int) -> None:
        if sequence > self._newest:
            shift = min(sequence - self._newest, SEEN_BITS)
            self._seen = self._seen << shift & (1 << SEEN_BITS) - 1
            self._newest = sequence
        if self._newest - sequence < SEEN_BITS:
            self._seen |= 1 << self._newest - sequence

    def is_over(self, now_ns: int) -> bool:
        """Whether the session is over. Ask only when no datagram is waiting."""
        first = self._first
        if first is None:
            return False
        silent_ns = now_ns - self._last_ns
        if self._end is not None:
            return min(silent_ns, now_ns - self._end_ns) > _AFTER_END_NS
        planned_ns = (first.planned - first.sequence) * first.period_ns
        over_ns = self._first_ns + planned_ns + _AFTER_SCHEDULE_NS
        if first.planned and now_ns > over_ns and silent_ns > _AFTER_SCHEDULE_NS:
            return True
        return silent_ns > self._silence_ns

    def finish(self, kernel_drops: int | None) -> ProbeResult | None:
        """Return what was received; None if nothing was."""
        first = self._first
        if first is None:
            return None
        outside = self._add_lost(first)
        sequence, sent_ns, received_ns = (
            np.array(column) for column in (self._sequence, self._sent_ns, self._received_ns)
        )
        lost = np.zeros(len(sequence), bool)
        lost[len(lost) - outside :] = True
        trace = packet_trace(sent_ns, received_ns, lost, sequence, clocks_differ=not self.is_same_host)
        notes = [self._end_note()]
        if not self.is_same_host:
            trace = relative_delays(trace)
            notes += trace.notes
        notes += ignored_lines(self.ignored)
        return ProbeResult(trace, tuple(notes), kernel_drops)

    def _add_lost(self, first: ProbeDatagram) -> int:
        """Add the first and the last datagram if they were lost; return how many were added.

        The trace has the others: a missing number is a lost packet.
        """
        earliest, latest = min(self._sequence), max(self._sequence)
        # Those before the first are lost if this process listened when they were sent.
        listened = self._first_ns - self._began_ns > first.sent_ns - first.start_ns
        sent_count = self._end.sequence if self._end is not None else 0
        # This number is from outside, too: it cannot be ahead of the schedule.
        longest_ns = self._end_ns - self._first_ns + _AHEAD_NS
        sent_count = min(sent_count, first.sequence + longest_ns // first.period_ns + 1)
        lost_ends = [(0, min(first.start_ns, min(self._sent_ns)))] if earliest and listened else []
        if sent_count > latest + 1:
            lost_ends.append((sent_count - 1, max(first.scheduled_ns(sent_count - 1), max(self._sent_ns))))
        for lost, at_ns in lost_ends:
            self._sequence.append(lost)
            self._sent_ns.append(at_ns)
            self._received_ns.append(-1)
            self._rows(lost, at_ns, "")
        return len(lost_ends)

    def _end_note(self) -> str:
        if self._end is None:
            return "no end datagram arrived: losses after the last received datagram are not counted"
        return late_sends(self._end.sequence, self._end.number, self._end.newest)
