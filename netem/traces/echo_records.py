"""Echo requests and their answers, as logs of ``ping`` and ``fping`` have them, as a packet trace.

A log has the round-trip time of each answer. When a request was sent follows from the time at which
its answer was printed, where the log has it, and otherwise from the period.
"""

from array import array
from collections.abc import Iterator
from typing import IO

import numpy as np

from netem.core.clock import NS_PER_S
from netem.traces.packet_trace import PacketTrace, TraceRecordError, packet_trace

NS_PER_MS = 1_000_000
_LINE_BYTES = 2**16
_MOST_MS = 1e12
_LATEST_NS = 2**62
_MOST_MISSING = 1000
"""Most requests without an answer per answered one, of a long log: two lines must not fill the memory."""
USUAL_PERIOD_NS = 1_000_000_000
"""Period of both programs unless an option sets another."""


def numbered_lines(file: IO[bytes]) -> Iterator[tuple[int, str]]:
    """Yield the lines of a log with their numbers from 1."""
    number = 0
    while line := file.readline(_LINE_BYTES):
        number += 1
        if len(line) == _LINE_BYTES:
            raise ValueError(f"line {number}: has more than {_LINE_BYTES} bytes; not a log")
        yield number, line.decode("utf-8", errors="replace").rstrip("\r\n")


def milliseconds(line: int, text: str) -> float:
    """Return a round-trip time; raise ValueError if it is none."""
    try:
        time_ms = float(text)
    except ValueError:
        time_ms = -1.0
    if not 0 <= time_ms < _MOST_MS:
        raise ValueError(f"line {line}: {text[:30]!r} is no round-trip time in ms")
    return time_ms


def _stamp_ns(line: int, text: str) -> int:
    """Return the time at which a line was printed, exactly; raise ValueError if it is too large."""
    whole, _, part = text.partition(".")
    time_ns = int(whole) * NS_PER_S + int(part.ljust(9, "0")[:9])
    if time_ns > _LATEST_NS:
        raise ValueError(f"line {line}: [{text}] is too late a time, in seconds since 1970")
    return time_ns


class EchoRecords:
    """Answers to numbered requests; numbers without an answer are lost."""

    def __init__(self, most_packets: int) -> None:
        self._most = most_packets
        self._numbers, self._rtt_ns, self._printed_ns = array("q"), array("q"), array("q")
        self._seen: set[int] = set()
        self._mentioned: set[int] = set()
        self.duplicates = 0
        """Answers that came again."""
        self.last: int | None = None
        """Largest number that the log has, answered or not."""

    def answer(self, line: int, number: int, time_ms: float, printed_s: str | None) -> None:
        """Add an answer; raise ValueError if there are too many."""
        self.mention(number)
        if number in self._seen:
            self.duplicates += 1
            return
        if len(self._numbers) == self._most:
            raise ValueError(f"line {line}: has more than {self._most} answers")
        self._seen.add(number)
        self._numbers.append(number)
        self._rtt_ns.append(round(time_ms * NS_PER_MS))
        self._printed_ns.append(-1 if printed_s is None else _stamp_ns(line, printed_s))

    def mention(self, number: int) -> None:
        """Note a number that the log has, such as that of a request without an answer."""
        self._mentioned.add(number)
        self.last = number if self.last is None else max(self.last, number)

    def __contains__(self, number: int) -> bool:
        return number in self._mentioned

    @property
    def smallest(self) -> int:
        """Smallest number that the log has; 1 if there is none."""
        return min(self._mentioned, default=1)

    def trace(self, first: int, count: int, period_ns: int | None, program: str) -> PacketTrace:
        """Return the trace of ``count`` requests from number ``first`` on.

        ``period_ns`` is that of the log's summary, if it has one.

        Raises:
            ValueError: one line; there are no requests, or their number is too large.
        """
        if count < 1:
            raise ValueError("has no requests")
        most = min(self._most, _MOST_MISSING * (len(self._numbers) + 1000))
        if count > most:
            raise ValueError(
                f"has {count} requests, of which {len(self._numbers)} are answered; at most {most} can be"
            )
        numbers, rtt_ns, printed_ns = map(np.array, (self._numbers, self._rtt_ns, self._printed_ns))
        everything = np.arange(first, first + count)
        notes = ["the delays are round-trip times"]
        if len(numbers) > 1 and (printed_ns >= 0).all() and np.ptp(numbers):
            order = np.argsort(numbers)
            known_ns = np.maximum.accumulate((printed_ns - rtt_ns)[order])
            slope = (int(known_ns[-1]) - int(known_ns[0])) / (int(numbers.max()) - int(numbers.min()))
            sent_ns = np.interp(everything, numbers[order], known_ns - known_ns[0]).round().astype(np.int64)
            before, behind = everything < numbers.min(), everything > numbers.max()
            sent_ns[before] = np.rint((everything[before] - numbers.min()) * slope).astype(np.int64)
            beyond = np.rint((everything[behind] - numbers.max()) * slope).astype(np.int64)
            sent_ns[behind] = int(known_ns[-1] - known_ns[0]) + beyond
        else:
            notes.append(
                f"the log has no times (-D): requests are taken as sent every "
                f"{(period_ns or USUAL_PERIOD_NS) / 1e9:g} s"
                + ("" if period_ns else f", as {program} does without an option")
            )
            sent_ns = np.arange(count) * (period_ns or USUAL_PERIOD_NS)
        lost = np.ones(count, np.bool_)
        lost[numbers - first] = False
        received_ns = sent_ns.copy()
        received_ns[numbers - first] += rtt_ns
        if self.duplicates:
            notes.append(f"answers that came twice: {self.duplicates}")
        try:
            trace = packet_trace(sent_ns, received_ns, lost, everything, most_packets=self._most)
        except TraceRecordError as error:
            raise ValueError(f"request {first + error.row} {error}") from None
        return trace.noted(*notes)
