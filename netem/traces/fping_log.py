"""Logs of ``fping``: a line per answer and target. Source: fping(8), ``-l``, ``-c``, ``-C``, ``-D``.

A log may have several targets; each is a flow of its own. Requests are numbered from 0. The line of
``-C`` at the end, with a time or ``-`` for each request, is read where there are no others.
"""

import re
from collections.abc import Mapping
from typing import IO

from netem.traces.echo_records import EchoRecords, milliseconds, numbered_lines
from netem.traces.packet_trace import PacketTrace, TraceFormat

_STAMP = r"(?:\[(\d{1,12}\.\d{1,9})\] )?"
_ANSWER = re.compile(_STAMP + r"(\S{1,255})\s+: \[(\d{1,10})\], (?:\d+ bytes, (\S+) ms\b|(timed out)\b)")
_NUMBERED = re.compile(_STAMP + r"(\S{1,255})\s+: \[(\d{1,10})\]")
_COLUMNS = re.compile(r"(\S{1,255})\s+: ((?:[0-9.]+|-)(?: (?:[0-9.]+|-))*)\s*")
_SUMMARY = re.compile(r"(\S{1,255})\s+: xmt/rcv/%loss = (\d{1,12})/")
_HEAD = re.compile(
    rb"(?m)^(?:\[\d+\.\d+\] )?\S+ +: "
    rb"(?:\[\d+\], (?:\d+ bytes|timed out)|xmt/rcv/|(?:[0-9.]+|-)(?: (?:[0-9.]+|-))*\s*$)"
)
_MOST_TARGETS = 10_000


def is_fping(head: bytes) -> bool:
    """Whether a file that begins with these bytes is a log of fping."""
    return _HEAD.search(head) is not None


def read_targets(file: IO[bytes], most_packets: int) -> Mapping[str, PacketTrace]:
    """Return the trace of each target, in the order of the log.

    Raises:
        ValueError: one line; it is not such a log, or a line is wrong.
    """
    records: dict[str, EchoRecords] = {}
    transmitted: dict[str, int] = {}
    columns: dict[str, tuple[int, list[str]]] = {}
    for line, text in numbered_lines(file):
        if (answer := _ANSWER.match(text)) is not None:
            printed_s, target, number, time_ms, _ = answer.groups()
            of_target = records.setdefault(target, EchoRecords(most_packets))
            if time_ms is None:
                of_target.mention(int(number))
            else:
                of_target.answer(line, int(number), milliseconds(line, time_ms), printed_s)
        elif (summary := _SUMMARY.match(text)) is not None:
            transmitted[summary[1]] = int(summary[2])
        elif (times := _COLUMNS.fullmatch(text)) is not None:
            columns[times[1]] = line, times[2].split()
        elif _NUMBERED.match(text):
            raise ValueError(f"line {line}: neither a time in ms nor timed out")
        if len(records) > _MOST_TARGETS:
            raise ValueError(f"has more than {_MOST_TARGETS} targets")
    for target, (line, times_ms) in columns.items():
        if target not in records:
            records[target] = EchoRecords(most_packets)
            for number, time in enumerate(times_ms):
                if time != "-":
                    records[target].answer(line, number, milliseconds(line, time), None)
            transmitted.setdefault(target, len(times_ms))
    if not records:
        raise ValueError("has no line per request; fping prints them with -l, -c or -C, not with -q")
    traces = {}
    for target, of_target in records.items():
        seen = -1 if of_target.last is None else of_target.last
        try:
            count = max(seen + 1, transmitted.get(target, 0))
            traces[target] = of_target.trace(0, count, None, "fping -l and -c")
        except ValueError as error:
            raise ValueError(f"{target}: {error}") from None
    return traces


def _first_target(file: IO[bytes], most_packets: int) -> PacketTrace:
    traces = read_targets(file, most_packets)
    target, trace = next(iter(traces.items()))
    return trace.noted(f"target 1 of {len(traces)}: {target}")


FPING = TraceFormat("fping", is_fping, lambda file, most, _: _first_target(file, most))
