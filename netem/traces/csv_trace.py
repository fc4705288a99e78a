"""CSV traces: a line per packet; the header names the columns, and the units of the times.

``sequence`` (optional: otherwise the packets are numbered in the order of the lines), ``sent_ms``
and ``received_ms``, or with the units ``_s``, ``_us``, ``_ns``; other columns are ignored. A packet
whose receiving time is empty or −1 was lost, as was one whose number is missing. Times are read as
decimals, and rounded to a whole nanosecond only. ``received_other_clock_ns`` says that the two
times were read on different clocks.
"""

import csv
import re
from array import array
from collections.abc import Iterator, Sequence
from decimal import Decimal
from typing import IO, NamedTuple

import numpy as np

from netem.core.errors import shortened
from netem.traces.packet_trace import (
    PacketTrace,
    TraceFormat,
    TraceRecordError,
    packet_trace,
    relative_delays,
)

_UNITS_NS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
_TIME_COLUMN = re.compile(f"(sent|received(?:_other_clock)?)_({'|'.join(_UNITS_NS)})")
_HEADER = re.compile(rb"(?!\{)(\xef\xbb\xbf)?[^\r\n]*(sent|received|sequence)")
_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,4})?")
_OTHER = "_other_clock"
_LOST = re.compile(r"(-1(\.0*)?)?")
_MOST = 2**62
"""Upper limit of times in ns and of sequence numbers."""
_LINE_BYTES = 2**16


class _Column(NamedTuple):
    name: str
    place: int
    scale: int

    def number(self, line: int, text: str) -> int:
        """Return a number, in ns for a time; raise ValueError if it is none, or too large."""
        exact = Decimal(text) * self.scale if _NUMBER.fullmatch(text) else None
        if exact is None:
            wrong = "not a number"
        elif abs(exact) >= _MOST:
            wrong = "too large"
        elif self.name == "sequence" and exact % 1:
            wrong = "not a whole number"
        else:
            return int(exact.to_integral_value())
        raise ValueError(f"line {line}: {self.name} is {shortened(text, 30)!r}, {wrong}")


def _columns(header: Sequence[str]) -> tuple[_Column | None, _Column, _Column]:
    """Return the columns of numbers (if there is one), of sending and of receiving times."""
    columns: dict[str, _Column] = {}
    for index, name in enumerate(header):
        time = _TIME_COLUMN.fullmatch(name)
        what = time[1].removesuffix(_OTHER) if time else name
        if what in columns and (time or what == "sequence"):
            raise ValueError(f"line 1: has the columns {columns[what].name} and {name}; one is needed")
        if time or what == "sequence":
            columns[what] = _Column(name, index, _UNITS_NS[time[2]] if time else 1)
    for what in ("sent", "received"):
        if what not in columns:
            raise ValueError(
                f"line 1: has no column {what}_ms (or _s, _us, _ns); "
                f"its columns: {shortened(', '.join(header))}"
            )
    return columns.get("sequence"), columns["sent"], columns["received"]


def _lines(file: IO[bytes]) -> Iterator[str]:
    while line := file.readline(_LINE_BYTES):
        if len(line) == _LINE_BYTES:
            raise ValueError(f"has a line of more than {_LINE_BYTES} bytes; not a CSV trace")
        yield line.decode("utf-8-sig", errors="replace")


def read_csv_trace(file: IO[bytes], most_packets: int, clocks_differ: bool) -> PacketTrace:
    """Read a CSV trace; see :class:`netem.traces.packet_trace.TraceFormat`."""
    trace, differ = _read(file, most_packets, clocks_differ)
    return relative_delays(trace) if differ else trace


def _read(file: IO[bytes], most_packets: int, clocks_differ: bool) -> tuple[PacketTrace, bool]:
    """Return the trace, and whether the clocks differ."""
    rows = csv.reader(_lines(file), skipinitialspace=True)
    lines, numbers, sent_ns, received_ns = (array("q") for _ in range(4))
    lost = bytearray()
    try:
        header = [name.strip() for name in next(rows, [])]
        sequence, sent, received = _columns(header)
        clocks_differ |= _OTHER in received.name
        for row in rows:
            line = rows.line_num
            if not row:
                continue
            if len(row) != len(header):
                raise ValueError(f"line {line}: has {len(row)} columns; the header has {len(header)}")
            if len(lines) == most_packets:
                raise ValueError(f"line {line}: has more than {most_packets} packets")
            # A packet without an arrival is lost.
            arrival = row[received.place].strip()
            lines.append(line)
            lost.append(is_lost := _LOST.fullmatch(arrival) is not None)
            received_ns.append(0 if is_lost else received.number(line, arrival))
            sent_ns.append(sent.number(line, row[sent.place].strip()))
            if sequence is not None:
                numbers.append(sequence.number(line, row[sequence.place].strip()))
        trace = packet_trace(
            np.array(sent_ns),
            np.array(received_ns),
            np.array(lost, np.bool_),
            np.array(numbers) if sequence is not None else None,
            clocks_differ=clocks_differ,
            most_packets=most_packets,
        )
        return trace, clocks_differ
    except csv.Error as error:
        raise ValueError(f"line {rows.line_num}: {error}") from None
    except TraceRecordError as error:
        raise ValueError(f"line {lines[error.row]}: {error}") from None


CSV = TraceFormat("CSV", lambda head: _HEADER.match(head) is not None, read_csv_trace)
