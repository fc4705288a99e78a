"""Reports of ``iperf3 -u --json``: losses per interval, not per packet.

Source: iperf3(1), and the JSON of iperf 3.12. The receiver's intervals have losses and jitter; those of a
sender have the number of packets alone, and the losses stand at the end.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from netem.core.errors import CallerError, printable, shortened
from netem.core.file_access import open_regular
from netem.traces.packet_trace import FILE_ERRORS, decompressed, file_problem

_MOST_BYTES = 64 * 2**20
_MOST_COUNT = 2**53
_MOST_S = 1e9


class LossInterval(NamedTuple):
    """What the receiver reports of one interval."""

    begin_s: float
    end_s: float
    packets: int
    lost: int
    jitter_s: float


class Stream(NamedTuple):
    """A stream of the test."""

    number: int
    packets: int
    lost: int
    out_of_order: int | None
    """None: not reported."""
    jitter_s: float
    """At the end."""
    intervals: tuple[LossInterval, ...]
    """Empty: the report is the sender's, which has no losses per interval."""


@dataclass(frozen=True)
class Iperf3Report:
    """A test by UDP."""

    streams: tuple[Stream, ...]
    duration_s: float
    payload_bytes: int
    is_reverse: bool
    """Whether the server sent."""


def is_iperf3(head: bytes) -> bool:
    """Whether a file that begins with these bytes is a report of iperf3."""
    begins = head.lstrip()[:1] == b"{"
    return begins and b'"start"' in head and (b'"connected"' in head or b'"event"' in head)


def read_iperf3(path: Path) -> Iperf3Report:
    """Read a report.

    Raises:
        CallerError: one line; it cannot be read, is damaged, or is not of a test by UDP.
    """
    try:
        with open_regular(path) as file:
            content = decompressed(file)[1].read(_MOST_BYTES + 1)
        if len(content) > _MOST_BYTES:
            raise ValueError(f"has more than {_MOST_BYTES >> 20} MiB")
        return _report(_document(content))
    except FILE_ERRORS as error:
        raise CallerError(f"{path}: {file_problem(error)}") from None


def _document(content: bytes) -> Mapping[str, Any]:
    text = content.decode("utf-8", errors="replace").lstrip()
    try:
        document, end = json.JSONDecoder().raw_decode(text)
    except json.JSONDecodeError as error:
        place = f"line {error.lineno}"
        raise ValueError(f"{place}: not JSON, or cut off: iperf3 did not end as it should") from None
    except (RecursionError, ValueError):
        raise ValueError("not a report of iperf3: its JSON is too deep, or has too long a number") from None
    if isinstance(document, dict) and "event" in document:
        raise ValueError("is of iperf3 --json-stream; give a report of iperf3 --json")
    if text[end:].strip():
        line = text[:end].count("\n") + 2
        raise ValueError(f"line {line}: something follows the report; give one report of iperf3 per file")
    if not isinstance(document, dict):
        raise ValueError("not a report of iperf3")
    return document


def _report(document: Mapping[str, Any]) -> Iperf3Report:
    if (error := document.get("error")) is not None:
        raise ValueError(f"iperf3 reports an error: {shortened(printable(str(error)))}")
    try:
        start, end = document["start"]["test_start"], document["end"]
        if start["protocol"] != "UDP":
            protocol = shortened(printable(str(start["protocol"])), 20)
            raise ValueError(f"is a test by {protocol}; give one by UDP (iperf3 -u)")
        streams = [stream["udp"] for stream in end["streams"] if "udp" in stream]
        if not streams:
            raise ValueError("has no streams at its end: iperf3 did not end as it should")
        numbers = {_count(stream["socket"], "socket"): index for index, stream in enumerate(streams)}
        intervals: list[list[LossInterval]] = [[] for _ in streams]
        for number, interval in enumerate(document["intervals"], 1):
            for entry in interval["streams"]:
                if entry.get("omitted") or "lost_packets" not in entry or entry["socket"] not in numbers:
                    continue
                intervals[numbers[entry["socket"]]].append(_interval(entry, number))
        return Iperf3Report(
            tuple(
                Stream(
                    index + 1,
                    _count(stream["packets"], "packets"),
                    _count(stream["lost_packets"], "lost_packets"),
                    _count(stream["out_of_order"], "out_of_order") if "out_of_order" in stream else None,
                    _time(stream["jitter_ms"], "jitter_ms") * 1e-3,
                    tuple(intervals[index]),
                )
                for index, stream in enumerate(streams)
            ),
            max(_time(stream["seconds"], "seconds") for stream in streams),
            _count(start.get("blksize", 0), "blksize"),
            bool(start.get("reverse")),
        )
    except (KeyError, TypeError, AttributeError) as error:
        missing = f" {error}" if isinstance(error, KeyError) else ""
        raise ValueError(f"not a whole report of iperf3 -u --json: lacks a value{missing}") from None


def _interval(entry: Mapping[str, Any], number: int) -> LossInterval:
    packets, lost = _count(entry["packets"], "packets"), _count(entry["lost_packets"], "lost_packets")
    if lost > packets:
        raise ValueError(f"interval {number}: has {lost} lost packets of {packets}")
    begin_s, end_s = _time(entry["start"], "start"), _time(entry["end"], "end")
    return LossInterval(begin_s, end_s, packets, lost, _time(entry["jitter_ms"], "jitter_ms") * 1e-3)


def _count(value: object, key: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < _MOST_COUNT:
        raise ValueError(f"{key} is {shortened(str(value), 30)}, not a number of packets or bytes")
    return value


def _time(value: object, key: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < _MOST_S:
        raise ValueError(f"{key} is {shortened(str(value), 30)}, not a time")
    return float(value)
