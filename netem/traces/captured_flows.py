"""The flows of a capture, and its datagrams, which are compared by hashes of their payloads."""

import hashlib
import os
from array import array
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import IO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from netem.traces.capture_packets import CapturedPacket, CutCaptureError, captured_packets
from netem.traces.captured_datagrams import CapturedDatagram, CapturedFlow, DatagramReader
from netem.traces.packet_trace import Int64s

_MOST_FLOWS = 1_000_000
_KEY = os.urandom(16)
"""Payloads are compared by a keyed hash, so that nobody can make two with the same."""
_MOST_BEHIND_NS = 10_000_000
"""Packets of one interface are in the order of their times, up to some ms between processors."""
_WHOLE = 2**62
"""Bytes of a payload of which nothing is cut."""


def payload_hash(payload: bytes, size_bytes: int, shown_bytes: int = _WHOLE) -> int:
    """Return the hash of a payload's size, and of its bytes as far as captures show them."""
    digest = hashlib.blake2b(payload[:shown_bytes], digest_size=8, key=_KEY, salt=size_bytes.to_bytes(4))
    return int.from_bytes(digest.digest(), "little", signed=True)


class Datagrams(NamedTuple):
    """Datagrams of a capture, sorted by time."""

    t_ns: Int64s
    hashes: Int64s  # Of the payloads
    flow: Int64s  # Places of the flows in :attr:`Capture.flows`
    size: Int64s  # Of the payloads, in bytes
    row: Int64s  # Numbers of the datagrams in the order of the file

    def where(self, which: NDArray[np.bool_] | Int64s | slice) -> "Datagrams":
        """Return those that are flagged, or those at some places."""
        return Datagrams(*(column[which] for column in self))


@dataclass
class _Span:
    begin_ns: int = 2**63 - 1
    end_ns: int = 0


class Capture:
    """A capture that has been read once: its flows, the largest first, and its datagrams.

    Raises:
        ValueError: it is not a capture, or has no UDP datagrams.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.notes: list[str] = []
        """Lines about the capture."""
        self.shown_bytes = _WHOLE
        """The shortest beginning of a payload that is cut."""
        self.cut = 0
        """Datagrams of which only the beginning was captured."""
        self.has_fragments = False
        """Whether datagrams arrived in fragments."""
        self.span = _Span()
        """The times of the first and of the last packet, also of those without datagrams."""
        self._dropped: dict[int, int] = {}
        self._first_fragments = 0
        self._hashed_bytes = _WHOLE
        counts: dict[CapturedFlow, list[int]] = {}
        columns = tuple(array("q") for _ in range(4))
        for datagram in self.read(self.notes):
            of_flow = counts.setdefault(datagram.flow, [len(counts), 0, datagram.interface, 0])
            of_flow[1] += 1
            of_flow[3] += datagram.is_merged
            if len(counts) > _MOST_FLOWS:
                raise ValueError(f"has more than {_MOST_FLOWS} flows; filter the capture first")
            if datagram.is_cut:
                self.cut += 1
                self.shown_bytes = min(self.shown_bytes, len(datagram.payload))
            hashed = payload_hash(datagram.payload, datagram.size_bytes)
            for column, value in zip(
                columns, (datagram.t_ns, hashed, of_flow[0], datagram.size_bytes), strict=True
            ):
                column.append(value)
        if not counts:
            cut = self.notes[0].partition(";")[0] if self.notes else ""
            raise ValueError(f"has no UDP datagrams{': ' if cut else ''}{cut}")
        self.flows = sorted(counts, key=lambda flow: -counts[flow][1])
        self._counts = [counts[flow][1] for flow in self.flows]
        self._interfaces = [counts[flow][2] for flow in self.flows]
        self._merged = [counts[flow][3] for flow in self.flows]
        places = np.argsort([counts[flow][0] for flow in self.flows])
        t_ns, hashes, flow, size = map(np.array, columns)
        order = np.argsort(t_ns, kind="stable")
        self.datagrams = Datagrams(t_ns, hashes, places[flow], size, np.arange(len(t_ns))).where(order)

    def choose(self, number: int, option: str = "--flow") -> CapturedFlow:
        """Return the flow of a number; 1 is the largest. Raise ValueError if there is none."""
        many = len(self.flows)
        if not 1 <= number <= many:
            raise ValueError(f"has no flow {number}; its flows are 1 to {many}")
        flow = self.flows[number - 1]
        others = f"; {option} chooses another of the {many} flows" if many > 1 else ""
        self.notes.append(f"flow {number}: {flow}, {self._counts[number - 1]} datagrams{others}")
        return flow

    def note_merged(self, place: int) -> None:
        """Note how many datagrams of a flow are longer than usual networks carry."""
        count = self._merged[place]
        if count and not self.has_fragments:
            self.notes.append(
                f"datagrams of more than 1500 bytes that are not fragmented: {count}; unless the network has "
                "jumbo frames, the kernel merged them (UDP GRO), and the numbers are those of merged ones"
            )

    def numbered(self, places: Sequence[int]) -> str:
        """Return flows with their numbers, for a line."""
        return "; ".join(f"flow {place + 1}: {self.flows[place]}" for place in places)

    def reverse_of(self, flow: CapturedFlow) -> list[int]:
        """Return the indices of the flows that go the other way."""
        return [index for index, name in enumerate(self.flows) if name.is_reverse_of(flow)]

    def dropped_at(self, place: int) -> int:
        """Return the packets that the capture itself dropped at the interface of a flow."""
        return self._dropped.get(self._interfaces[place], 0)

    def show(self, shown_bytes: int) -> None:
        """Compare payloads by their size and by so many bytes at their beginning."""
        if shown_bytes >= self._hashed_bytes:
            return
        self._hashed_bytes = shown_bytes
        hashes = array("q")
        for datagram in self.read():
            hashes.append(payload_hash(datagram.payload, datagram.size_bytes, shown_bytes))
        self.datagrams = self.datagrams._replace(hashes=np.array(hashes)[self.datagrams.row])
        if self.cut:
            text = f"payloads are compared by their length and first {shown_bytes} bytes"
            self.notes.append(f"{text}{self.problem()}")

    @property
    def is_whole(self) -> bool:
        """Whether whole payloads are compared."""
        return self._hashed_bytes == _WHOLE

    def shown_text(self) -> str:
        """Return the bytes by which payloads are compared, for a line; empty: all."""
        if self.is_whole:
            return ""
        return (
            f" in the first {self._hashed_bytes} bytes, all that the snap length or missing fragments leave"
        )

    def problem(self) -> str:
        """Return why payloads are not whole, for a line."""
        whole = self.cut - self._first_fragments
        reasons = []
        if whole:
            reasons.append(f"{whole} are cut by the snap length (capture with tcpdump -s 0)")
        if self._first_fragments:
            reasons.append(
                f"of {self._first_fragments} it has the first fragment only (capture without a port filter)"
            )
        return f": {', '.join(reasons)}" if reasons else ""

    def read(self, notes: list[str] | None = None) -> Iterator[CapturedDatagram]:
        """Yield the UDP datagrams, always in the same order."""
        reader = DatagramReader()
        dropped: dict[int, int] = {}
        cut_off = ""
        try:
            yield from reader.read(_ascending(captured_packets(self._file, dropped), self.span))
        except CutCaptureError as error:
            cut_off = f"the capture {error}; what is before is used"
        yield from reader.rest()
        if notes is None:
            return
        self.has_fragments = reader.has_fragments
        self._dropped, self._first_fragments = dropped, reader.first_fragments
        if cut_off:
            notes.append(cut_off)
        for link_type, count in reader.unsupported.items():
            notes.append(
                f"{count} packets have link type {link_type}, which is not supported; "
                "capture Ethernet, Linux cooked or raw IP"
            )
        if reader.incomplete:
            notes.append(f"datagrams that did not arrive because fragments are missing: {reader.incomplete}")


def _ascending(packets: Iterable[CapturedPacket], span: _Span) -> Iterator[CapturedPacket]:
    """Yield packets, and note their times; refuse them if the clock was set back on an interface."""
    latest_ns: dict[int, int] = {}
    for count, packet in enumerate(packets, 1):
        behind_ns = latest_ns.setdefault(packet.interface, packet.t_ns) - packet.t_ns
        if behind_ns > _MOST_BEHIND_NS:
            raise ValueError(
                f"packet {count} is {behind_ns / 1e9:.6g} s older than one before it: the clock was set "
                "back, and the order and times are not known; measure the parts "
                f"(editcap -r FILE PART 1-{count - 1}), "
                "or sort the file if it was joined in the wrong order (reordercap)"
            )
        latest_ns[packet.interface] = max(latest_ns[packet.interface], packet.t_ns)
        span.begin_ns = min(span.begin_ns, packet.t_ns)
        span.end_ns = max(span.end_ns, packet.t_ns)
        yield packet


def matches(sent: Datagrams, received: Datagrams) -> tuple[Int64s, Int64s]:
    """Return the places of received datagrams with the payload of a sent one, and of the latter."""
    if not len(sent.hashes):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    hashes, places = np.unique(sent.hashes, return_index=True)
    at = np.minimum(np.searchsorted(hashes, received.hashes), len(hashes) - 1)
    known = np.flatnonzero(hashes[at] == received.hashes)
    return known, places[at[known]]
