"""The sender of a probe: what to send when, and the answers of a round-trip probe.

It reads no clock. Deadlines are absolute: a late datagram is sent late, and none is left out.
"""

from array import array
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.measurement.live.probe_result import ProbeResult, counted, late_sends
from noack.core.clock import NS_PER_S
from noack.protocol.probe_format import (
    PROBE_BYTES,
    SEEN_BITS,
    ProbeDatagram,
    ProbeKind,
    decode_probe,
    encode_probe,
)
from noack.traces.packet_trace import LOST_NS, packet_trace

_ENDS = 20
_END_PERIOD_NS = NS_PER_S // 10
_LATE_NS = 1_000_000
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
        self._content = ProbeDatagram(
            self._kind, session, host, 0, 0, start_ns, plan.period_ns, plan.planned
        )
        self._sent_ns, self._received_ns = array("q"), array("q")
        self._to_send = plan.planned
        self._late = self._longest_late_ns = 0
        self._late_ns = min(_LATE_NS, plan.period_ns)
        self.ends = 0
        """Number of END datagrams sent so far."""
        self._ended_ns = 0
        self._all_answers: int | None = None
        self._numbers, self._newest, self._seen = array("Q"), array("Q"), bytearray()
        self._ignored: Counter[str] = Counter()
        rows(*(["sequence", "sent_ns", "received_ns", "lost"] if plan.is_round_trip
               else ["sequence", "sent_ns", "late_ns"]))  # fmt: skip

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
                kind=ProbeKind.END, sequence=self.sent, sent_ns=now_ns, planned=self._to_send,
                number=self._late, newest=self._longest_late_ns,
            )  # fmt: skip
            return encode_probe(end, self._plan.size_bytes)
        late_ns = now_ns - self.next_deadline_ns()
        if late_ns > self._late_ns:
            self._late += 1
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
        notes = [late_sends(self.sent, self._late, self._longest_late_ns)]
        if not self._plan.is_round_trip or not self.sent:
            return ProbeResult(None, tuple(notes), kernel_drops)
        sent_ns, received_ns = np.array(self._sent_ns), np.array(self._received_ns)
        lost = received_ns == LOST_NS
        ways = self.lost_ways()
        for sequence, way in ways.items():
            self._rows(sequence, self._sent_ns[sequence], "", way)
        notes.append(self._losses_by_way(list(ways.values())))
        notes += counted(self._ignored)
        return ProbeResult(packet_trace(sent_ns, received_ns, lost), tuple(notes), kernel_drops)

    def lost_ways(self) -> dict[int, str]:
        """Return on which way each datagram without an answer was lost.

        Each answer has the newest sequence number that had arrived, and which of the 128 up to it.
        A number that no answer covers was lost on an unknown way.
        """
        arrived, covered = self._arrived()
        lost = np.flatnonzero(np.array(self._received_ns) == LOST_NS)
        return {
            int(k): _REVERSE if arrived[k] else _FORWARD if covered[k] else _UNKNOWN for k in lost
        }

    def _arrived(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return which numbers the answers show as arrived, and which they cover."""
        arrived, covered = np.zeros(self.sent, bool), np.zeros(self.sent, bool)
        seen = np.frombuffer(bytes(self._seen), np.uint8).reshape(-1, SEEN_BITS // 8)
        for at in range(0, len(seen), _ANSWERS_AT_ONCE):
            part = slice(at, at + _ANSWERS_AT_ONCE)
            bits = np.unpackbits(seen[part], axis=1, bitorder="little").astype(bool)
            newest = np.array(self._newest[part]).astype(np.int64)
            numbers = newest[:, None] - np.arange(SEEN_BITS)
            inside = (numbers >= 0) & (numbers < self.sent)
            covered[numbers[inside]] = True
            arrived[numbers[inside & bits]] = True
        return arrived, covered

    def _losses_by_way(self, ways: list[str]) -> str:
        counts = Counter(ways)
        text = f"lost forward: {counts[_FORWARD]}; lost in reverse: {counts[_REVERSE]}"
        if not counts[_UNKNOWN]:
            return text
        answers = self._all_answers
        if answers is None:
            answers = max(self._numbers, default=-1) + 1
        reverse = min(max(answers - len(self._numbers) - counts[_REVERSE], 0), counts[_UNKNOWN])
        return (
            f"{text}; lost on an unknown way: {counts[_UNKNOWN]}, "
            f"of which at least {reverse} in reverse by the numbers of the answers"
        )
