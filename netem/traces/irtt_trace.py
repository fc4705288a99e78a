"""Round trips measured by IRTT: the JSON document of ``irtt client -o FILE``.

Only ``round_trips`` is read, entry by entry; the times are those of the client's monotonic clock.
Source: irtt-client(1), JSON FORMAT.
"""

import json
from array import array
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from typing import IO, Any

import numpy as np

from netem.traces.packet_trace import LOST_NS, PacketTrace, TraceFormat, TraceRecordError, packet_trace

_PIECE = 2**16
"""Bytes that are read at once."""
_LONGEST_ENTRY = 2**16
_LONGEST_BEGINNING = 2**22
"""Most characters of a round trip, and of what is before the first one."""
_KEY = '"round_trips"'
_MOST = 2**62
"""Upper limit of times in ns."""
_WAYS = {"true_up": "forward", "true_down": "in reverse", "true": "in an unknown direction"}


def read_irtt(file: IO[bytes], most_packets: int) -> PacketTrace:
    """Read the round trips.

    Raises:
        ValueError: one line; it is not such a document, or an entry is wrong.
    """
    numbers, sent_ns, received_ns = array("q"), array("q"), array("q")
    ways: Counter[str] = Counter()
    try:
        for entry in _entries(_texts(file)):
            if len(numbers) == most_packets:
                raise ValueError(f"has more than {most_packets} round trips")
            number, sent, received, way = _values(entry, len(numbers))
            numbers.append(number)
            sent_ns.append(sent)
            received_ns.append(received)
            ways[way] += 1
        arrivals_ns = np.array(received_ns)
        trace = packet_trace(
            np.array(sent_ns),
            arrivals_ns,
            arrivals_ns == LOST_NS,
            np.array(numbers),
            most_packets=most_packets,
        )
    except TraceRecordError as error:
        raise ValueError(f"round trip {error.row + 1}: {error}") from None
    notes = [f"lost {_WAYS[way]}: {ways[way]}" for way in _WAYS if ways[way]]
    return trace.noted("the delays are round-trip times", *notes)


def _texts(file: IO[bytes]) -> Iterator[str]:
    while piece := file.read(_PIECE):
        yield piece.decode("ascii", errors="replace")  # only numbers and fixed words are used


def _entries(texts: Iterator[str]) -> Iterator[object]:
    """Yield the entries of the list of round trips, of a document that is read piece by piece."""
    text = _after_bracket(texts)
    decode = json.JSONDecoder().raw_decode
    while True:
        text = text.lstrip(" \t\r\n,")
        if text.startswith("]"):
            return
        with suppress(json.JSONDecodeError, RecursionError):
            entry, end = decode(text)
            yield entry
            text = text[end:]
            continue
        piece = next(texts, "")
        if not piece:
            raise ValueError("ends within its round trips, or has an entry that is not JSON")
        if len(text) > _LONGEST_ENTRY:
            raise ValueError(f"has a round trip of more than {_LONGEST_ENTRY} characters, or no JSON")
        text += piece


def _after_bracket(texts: Iterator[str]) -> str:
    """Return what has been read behind the bracket with which the list of round trips begins."""
    text = ""
    for piece in texts:
        text += piece
        at = text.find(_KEY)
        if at >= 0 and "[" in text[at:]:
            break
        if len(text) > _LONGEST_BEGINNING:
            raise ValueError(f"has no {_KEY} in its first {_LONGEST_BEGINNING >> 20} MiB")
    else:
        raise ValueError(f"has no list {_KEY}")
    before, _, after = text[at + len(_KEY) :].partition("[")
    if before.strip() != ":":
        raise ValueError(f"{_KEY} is not a list")
    return after


def _values(entry: Any, index: int) -> tuple[int, int, int, str]:
    """Return number, times of sending and receiving, and whether and where it was lost."""
    try:
        client = entry["timestamps"]["client"]
        number, sent_ns = entry["seqno"], client["send"]["monotonic"]
        way = str(entry["lost"]).lower()
        received_ns = LOST_NS if way in _WAYS else client["receive"]["monotonic"]
        values = number, sent_ns, received_ns
        if way not in ("false", *_WAYS) or not all(type(value) is int for value in values):
            raise TypeError
        if not all(abs(value) < _MOST for value in values):
            raise ValueError(f"round trip {index + 1}: has a number that is too large")
    except (KeyError, TypeError, IndexError):
        raise ValueError(
            f"round trip {index + 1}: expected seqno, lost, and timestamps of the client with "
            "send and receive, in ns of the monotonic clock"
        ) from None
    return (*values, way)


def _is_irtt(head: bytes) -> bool:
    return head.lstrip()[:1] == b"{" and (b'"irtt"' in head or b'"round_trips"' in head)


IRTT = TraceFormat("IRTT", _is_irtt, lambda file, most, _: read_irtt(file, most))
