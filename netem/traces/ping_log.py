"""Logs of ``ping``: a line per answer, and a summary. Source: ping(8) of iputils; BSD's is alike.

``icmp_seq`` has 16 bits, and wraps around. Numbers without an answer are lost requests: also those
that the summary counts behind the last answer. A log without a summary ends with its last number.
"""

import re
from typing import IO

from netem.traces.echo_records import NS_PER_MS, EchoRecords, milliseconds, numbered_lines
from netem.traces.packet_trace import PacketTrace, TraceFormat

_HEAD = re.compile(rb"(?m)^PING |\bicmp_seq[= ]\d+")
_ANSWER = re.compile(r"(?:\[(\d{1,12}\.\d{1,9})\] )?\d+ bytes from .*?\b(?:icmp_)?seq=(\d{1,10})\b(.*)")
_TIME = re.compile(r"\btime[=<]([0-9.eE+-]+) ?ms")
_UNANSWERED = re.compile(r".*?(?:no answer yet for icmp_seq=|Request timeout for icmp_seq )(\d{1,10})\b")
_REFUSED = re.compile(r"(?:\[[\d.]+\] )?From .*?icmp_seq=(\d{1,10})\b")
_SUMMARY = re.compile(r"(\d{1,12}) packets transmitted, .*?received.*?(?:, time (\d{1,15}) ?ms)?$")
_WRAP = 2**16


def read_ping(file: IO[bytes], most_packets: int) -> PacketTrace:
    """Read a log.

    Raises:
        ValueError: one line; it is not such a log, or an answer is wrong.
    """
    records, refused = EchoRecords(most_packets), 0
    begins, summary = False, None
    for line, text in numbered_lines(file):
        begins |= text.startswith("PING ")
        if (answer := _ANSWER.match(text)) is not None:
            time = _TIME.search(answer[3])
            if time is None:
                raise ValueError(f"line {line}: has no time=; ping shows one from -s 16 on")
            number = _unwrapped(int(answer[2]), records.last)
            records.answer(line, number, milliseconds(line, time[1]), answer[1])
        elif (unanswered := _UNANSWERED.match(text) or _REFUSED.match(text)) is not None:
            records.mention(_unwrapped(int(unanswered[1]), records.last))
            refused += text.partition("From ")[2] != ""
        elif (found := _SUMMARY.match(text)) is not None:
            if summary is not None:
                raise ValueError(f"line {line}: a second summary; give the log of one ping at a time")
            summary = found
    if summary is None and records.last is None:
        raise ValueError("has no answers and no summary; not a log of ping, or of ping -q or -f")
    first = 0 if 0 in records else 1 if begins else records.smallest
    count = (first if records.last is None else records.last + 1) - first
    period_ns = None
    if summary is not None:
        count = max(count, int(summary[1]))
        if summary[2] and int(summary[1]) > 1:
            period_ns = int(summary[2]) * NS_PER_MS // (int(summary[1]) - 1) or None
    trace = records.trace(first, count, period_ns, "ping")
    notes = [] if summary else ["no summary at its end: requests behind the last line are not known"]
    if refused:
        notes.append(f"lines in which a router reports an error, which count as lost: {refused}")
    return trace.noted(*notes)


def _unwrapped(number: int, last: int | None) -> int:
    """Return a number of 16 bits as the nearest one to the last."""
    if last is None or number >= _WRAP:
        return number
    nearest = number + (last - number + _WRAP // 2) // _WRAP * _WRAP
    return max(nearest, number)


PING = TraceFormat(
    "ping", lambda head: _HEAD.search(head) is not None, lambda file, most, _: read_ping(file, most)
)
