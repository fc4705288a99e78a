"""Packet traces from captures.

* Two captures, of the sender's and of the receiver's end: the datagrams are matched by payload. The
  clocks differ, unless the user says otherwise.
* One capture with both ends, such as the emulator writes: the same, with one clock.
* One capture of the receiver's end: numbers at a known place of the payload, for a sender with a
  fixed period.

A flow is a pair of addresses at an interface. The largest is taken, unless the user names another.
"""

import hashlib
import os
import re
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import IO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.row_operations import firsts_of_equal
from noack.traces.capture_packets import CapturedFlow, CutCaptureError, captured_packets, find_udp, is_capture
from noack.traces.packet_trace import (
    MAX_PACKETS,
    Int64s,
    PacketTrace,
    TraceFormat,
    TraceRecordError,
    envelope_slope,
    packet_trace,
    relative_delays,
)

_MOST_FLOWS = 1_000_000
_KEY = os.urandom(16)
"""Payloads are compared by a keyed hash, so that nobody can make two with the same."""
_FIELD = re.compile(r"([0-9]{1,5}):([1-8])(:little)?")
_MOST = 2**62
"""Upper limit of sequence numbers."""


class CapturedDatagram(NamedTuple):
    """A UDP datagram of a capture."""

    t_ns: int
    flow: CapturedFlow
    payload: bytes
    is_cut: bool  # Whether only its beginning was captured
    is_outbound: bool


class Datagrams(NamedTuple):
    """The complete datagrams of a capture, sorted by time."""

    t_ns: Int64s
    hashes: Int64s  # Of the payloads
    flow: Int64s  # Places of the flows in :attr:`Capture.flows`

    def where(self, flags: NDArray[np.bool_]) -> "Datagrams":
        """Return those that are flagged."""
        return Datagrams(*(column[flags] for column in self))


class Capture:
    """A capture that has been read once: its flows, the largest first, and its datagrams.

    Raises:
        ValueError: it is not a capture, or has no UDP datagrams.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.notes: list[str] = []
        """Lines about the capture."""
        counts: dict[CapturedFlow, list[int]] = {}
        columns = array("q"), array("q"), array("q")
        for datagram in self.read(self.notes):
            number_and_count = counts.setdefault(datagram.flow, [len(counts), 0])
            number_and_count[1] += 1
            if len(counts) > _MOST_FLOWS:
                raise ValueError(f"has more than {_MOST_FLOWS} flows; filter the capture first")
            if not datagram.is_cut:
                digest = hashlib.blake2b(datagram.payload, digest_size=8, key=_KEY).digest()
                hashed = int.from_bytes(digest, "little", signed=True)
                for column, value in zip(columns, (datagram.t_ns, hashed, number_and_count[0]), strict=True):
                    column.append(value)
        if not counts:
            cut = self.notes[0].partition(";")[0] if self.notes else ""
            raise ValueError(f"has no UDP datagrams{': ' if cut else ''}{cut}")
        self.flows = sorted(counts, key=lambda flow: -counts[flow][1])
        self._counts = [counts[flow][1] for flow in self.flows]
        places = np.argsort([counts[flow][0] for flow in self.flows])
        order = np.argsort(np.array(columns[0]), kind="stable")
        t_ns, hashes, flow = (np.array(column)[order] for column in columns)
        self.complete = Datagrams(t_ns, hashes, places[flow])

    def choose(self, number: int) -> CapturedFlow:
        """Return the flow of a number; 1 is the largest. Raise ValueError if there is none."""
        many = len(self.flows)
        if not 1 <= number <= many:
            raise ValueError(f"has no flow {number}; its flows are 1 to {many}")
        flow = self.flows[number - 1]
        others = f"; --flow chooses another of the {many} flows" if many > 1 else ""
        self.notes.append(f"flow {number}: {flow}, {self._counts[number - 1]} datagrams{others}")
        return flow

    def reverse_of(self, flow: CapturedFlow) -> list[int]:
        """Return the indices of the flows that go the other way."""
        return [index for index, name in enumerate(self.flows) if name.is_reverse_of(flow)]

    def read(self, notes: list[str] | None = None) -> Iterator[CapturedDatagram]:
        """Yield the UDP datagrams."""
        try:
            for packet in captured_packets(self._file):
                datagram = find_udp(packet.interface, packet.link_type, packet.data)
                if datagram is None:
                    continue
                flow, payload, is_complete = datagram
                yield CapturedDatagram(packet.t_ns, flow, payload, not is_complete, packet.is_outbound)
        except CutCaptureError as error:
            if notes is not None:
                notes.append(f"the capture {error}; what is before is used")


def two_captures(sender: Capture, flow: CapturedFlow, receiver: Capture) -> tuple[Datagrams, Datagrams]:
    """Return the datagrams of a flow at its sender, and all that may be the same at the receiver.

    The addresses may differ (NAT, a relay); only the reverse flow of an echo is left out.
    """
    sent, received = sender.complete, receiver.complete
    return (
        sent.where(sent.flow == sender.flows.index(flow)),
        received.where(~np.isin(received.flow, receiver.reverse_of(flow))),
    )


def one_capture(capture: Capture, flow: CapturedFlow) -> tuple[Datagrams, Datagrams] | None:
    """Return the datagrams at the two ends in one capture; None if it has one end only."""
    everything, number = capture.complete, capture.flows.index(flow)
    mine = everything.where(everything.flow == number)
    others = everything.where(~np.isin(everything.flow, [number, *capture.reverse_of(flow)]))
    received, sent = _matches(mine, others)
    if not len(sent):
        return None
    of_flow = others.flow[received]
    counts = np.bincount(of_flow)
    delays_ns = others.t_ns[received] - mine.t_ns[sent]
    # A reverse flow with the same payloads (an echo) takes longer.
    likely = np.flatnonzero(2 * counts > counts.max())
    medians = {int(k): float(np.median(delays_ns[of_flow == k])) for k in likely}
    other = min(medians, key=lambda k: abs(medians[k]))
    capture.notes.append(f"the other end: {capture.flows[other]}")
    theirs = others.where(others.flow == other)
    return (mine, theirs) if medians[other] >= 0 else (theirs, mine)


def matched_trace(
    sent: Datagrams, received: Datagrams, clocks_differ: bool, most: int, notes: list[str]
) -> PacketTrace:
    """Return the trace of the sent datagrams.

    Raises:
        ValueError: payloads are repeated, or none has arrived.
    """
    repeated = len(sent.hashes) - len(np.unique(sent.hashes))
    if repeated:
        raise ValueError(
            f"{repeated} of {len(sent.hashes)} datagrams have the payload of another one, and "
            "cannot be matched; if they are numbered, give the receiver's capture with "
            "--sequence-at OFFSET:BYTES"
        )
    here, there = _matches(sent, received)
    arrived, first = np.unique(there, return_index=True)
    if not len(arrived):
        raise ValueError(
            "none of the complete datagrams sent is in the receiver's capture; are both captures "
            "of whole packets (tcpdump -s 0), and of the same time?"
        )
    if len(there) > len(arrived):
        notes.append(f"duplicates at the receiver: {len(there) - len(arrived)}")
    for where, outside in (("first", arrived[0]), ("last", len(sent.t_ns) - 1 - arrived[-1])):
        if outside:
            notes.append(
                f"the {where} {outside} sent datagrams did not arrive; if the receiver's capture "
                "did not run then, they are no losses"
            )
    received_ns = np.zeros(len(sent.t_ns), np.int64)
    received_ns[arrived] = received.t_ns[here[first]]
    lost = np.ones(len(sent.t_ns), bool)
    lost[arrived] = False
    trace = packet_trace(sent.t_ns, received_ns, lost, clocks_differ=clocks_differ, most_packets=most)
    return relative_delays(trace) if clocks_differ else trace


def _matches(sent: Datagrams, received: Datagrams) -> tuple[Int64s, Int64s]:
    """Return the places of received datagrams with the payload of a sent one, and of the latter."""
    if not len(sent.hashes):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    hashes, places = np.unique(sent.hashes, return_index=True)
    at = np.minimum(np.searchsorted(hashes, received.hashes), len(hashes) - 1)
    known = np.flatnonzero(hashes[at] == received.hashes)
    return known, places[at[known]]


class SequenceField(NamedTuple):
    """Where a payload has its sequence number."""

    offset: int
    size_bytes: int
    is_little: bool

    @classmethod
    def parse(cls, text: str) -> "SequenceField":
        """Parse ``OFFSET:BYTES`` or ``OFFSET:BYTES:little``; raise ValueError if it is neither."""
        match = _FIELD.fullmatch(text)
        if match is None:
            raise ValueError(
                f"expected OFFSET:BYTES with 1 to 8 bytes, e.g. 2:2 for RTP, or 8:4:little; found {text!r}"
            )
        return cls(int(match[1]), int(match[2]), match[3] is not None)

    def read(self, payload: bytes) -> int | None:
        """Return the number; None if the payload is too short, or the number too large."""
        part = payload[self.offset : self.offset + self.size_bytes]
        if len(part) < self.size_bytes:
            return None
        number = int.from_bytes(part, "little" if self.is_little else "big")
        return number if number < _MOST else None


class _Numbered(NamedTuple):
    number: Int64s
    received_ns: Int64s


def _numbered(capture: Capture, flow: CapturedFlow, field: SequenceField) -> _Numbered:
    """Return the numbers and times of arrival of a flow, and check its direction."""
    numbers, received_ns = array("q"), array("q")
    outbound = 0
    for datagram in capture.read():
        if datagram.flow == flow and (number := field.read(datagram.payload)) is not None:
            outbound += datagram.is_outbound
            numbers.append(number)
            received_ns.append(datagram.t_ns)
    if numbers and outbound == len(numbers):
        raise ValueError(
            "shows the sender's end only, where nothing is lost yet; capture at the receiver, or "
            "give the captures of both ends"
        )
    return _Numbered(np.array(numbers), np.array(received_ns))


def _first_of_each(numbered: _Numbered, notes: list[str]) -> _Numbered:
    order = np.lexsort((numbered.received_ns, numbered.number))
    number = numbered.number[order]
    first = order[firsts_of_equal(number)]
    if len(first) < len(order):
        notes.append(f"duplicates: {len(order) - len(first)}; the first counts")
    return _Numbered(*(column[first] for column in numbered))


def trace_of_numbers(
    capture: Capture, flow: CapturedFlow, field: SequenceField, most_packets: int
) -> PacketTrace:
    """Return the trace of a sender with a constant period; the payloads have a number each."""
    numbered = _numbered(capture, flow, field)
    if len(numbered.number) < 2:
        raise ValueError(
            f"fewer than two datagrams have a sequence number at {field.offset}:{field.size_bytes}"
        )
    # Numbers that begin again at 0 go on, in the order of the arrivals.
    order = np.argsort(numbered.received_ns, kind="stable")
    number = _unwrapped(numbered.number[order], 8 * field.size_bytes)
    numbered = _first_of_each(_Numbered(number, numbered.received_ns[order]), capture.notes)
    k = numbered.number - numbered.number[0]
    received_ns = numbered.received_ns - numbered.received_ns.min()
    if k[-1] >= most_packets:
        raise ValueError(
            f"the sequence numbers span {k[-1] + 1} packets; at most {most_packets} can "
            "be; check --sequence-at"
        )
    # The sending times: those of a constant period, below all arrivals.
    period_ns = max(envelope_slope(k, received_ns), 0.0)
    sent_ns = np.rint(period_ns * k).astype(np.int64)
    capture.notes.append(
        f"the capture has no sending times: the sender's period is assumed to be constant, "
        f"{period_ns / 1e6:.6g} ms (lower envelope of the arrivals); delays are relative"
    )
    return packet_trace(
        sent_ns,
        received_ns,
        np.zeros(len(k), bool),
        numbered.number,
        clocks_differ=True,
        most_packets=most_packets,
    )


def _unwrapped(number: Int64s, bits: int) -> NDArray[np.int64]:
    """Return numbers in the order of arrival without wrap-around; ``bits`` is the field's size."""
    if bits > 32:
        return number
    half = 1 << bits - 1
    steps = (np.diff(number) + half) % (1 << bits) - half
    return np.concatenate((number[:1], number[0] + np.cumsum(steps)))


@dataclass(frozen=True)
class CaptureOptions:
    """How to read captures."""

    flow: int = 1  # Which flow, by its number of datagrams; 1 is the largest
    sequence_at: SequenceField | None = None
    clocks_differ: bool | None = None  # None: only if there are two captures
    most_packets: int = MAX_PACKETS


def read_captures(files: Sequence[IO[bytes]], options: CaptureOptions) -> PacketTrace:
    """Return the trace in one capture, or in those of the sender's and of the receiver's end.

    Raises:
        ValueError: one line; it is not a capture, or the datagrams cannot be matched.
    """
    capture = Capture(files[0])
    flow = capture.choose(options.flow)
    try:
        trace = _trace(capture, flow, files[1:], options)
    except TraceRecordError as error:
        raise ValueError(f"datagram {error.row + 1} of the flow {error}") from None
    return trace.noted(*capture.notes)


def _trace(
    capture: Capture, flow: CapturedFlow, others: Sequence[IO[bytes]], options: CaptureOptions
) -> PacketTrace:
    most = options.most_packets
    if options.sequence_at is not None:
        if others:
            raise ValueError("--sequence-at needs the receiver's capture only")
        return trace_of_numbers(capture, flow, options.sequence_at, most)
    if others:
        receiver = Capture(others[0])
        capture.notes += receiver.notes
        ends = two_captures(capture, flow, receiver)
    else:
        both_ends = one_capture(capture, flow)
        if both_ends is None:
            raise ValueError(
                "has one end only; give the captures of both ends, or say where the payload has a "
                "sequence number: --sequence-at OFFSET:BYTES"
            )
        ends = both_ends
    differ = bool(others) if options.clocks_differ is None else options.clocks_differ
    return matched_trace(*ends, differ, most, capture.notes)


def _read(file: IO[bytes], most_packets: int, clocks_differ: bool) -> PacketTrace:
    options = CaptureOptions(clocks_differ=clocks_differ or None, most_packets=most_packets)
    return read_captures([file], options)


CAPTURE = TraceFormat("pcap", is_capture, _read)
