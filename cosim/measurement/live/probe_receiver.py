"""The receiver of a probe: keeps when each datagram was sent and received. It reads no clock."""

from array import array
from collections import Counter
from collections.abc import Callable

import numpy as np

from cosim.measurement.live.probe_result import ProbeResult, counted, late_sends
from noack.core.clock import NS_PER_S
from noack.protocol.probe_format import (
    MAX_PROBES,
    SEEN_BITS,
    ProbeDatagram,
    ProbeKind,
    decode_probe,
    encode_probe,
)
from noack.traces.packet_trace import packet_trace, relative_delays

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
        silence_ns: the session is over after so long without a datagram.
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
        trace = packet_trace(
            sent_ns, received_ns, lost, sequence, clocks_differ=not self.is_same_host
        )
        notes = [self._ending()]
        if not self.is_same_host:
            trace = relative_delays(trace)
            notes += trace.notes
        notes += counted(self.ignored)
        return ProbeResult(trace, tuple(notes), kernel_drops)

    def _add_lost(self, first: ProbeDatagram) -> int:
        """Add the first and the last datagram if they were lost; return how many were added.

        The trace has the others: a missing number is a lost packet.
        """
        earliest, latest = min(self._sequence), max(self._sequence)
        # Those before the first are lost if this process listened when they were sent.
        listened = self._first_ns - self._began_ns > first.sent_ns - first.start_ns
        sent = self._end.sequence if self._end is not None else 0
        # This number is from outside, too: it cannot be ahead of the schedule.
        longest_ns = self._end_ns - self._first_ns + _AHEAD_NS
        sent = min(sent, first.sequence + longest_ns // first.period_ns + 1)
        added = [(0, min(first.start_ns, min(self._sent_ns)))] if earliest and listened else []
        if sent > latest + 1:
            added.append((sent - 1, max(first.scheduled_ns(sent - 1), max(self._sent_ns))))
        for lost, at_ns in added:
            self._sequence.append(lost)
            self._sent_ns.append(at_ns)
            self._received_ns.append(-1)
            self._rows(lost, at_ns, "")
        return len(added)

    def _ending(self) -> str:
        if self._end is None:
            return (
                "no end datagram arrived: losses after the last received datagram are not counted"
            )
        return late_sends(self._end.sequence, self._end.number, self._end.newest)
