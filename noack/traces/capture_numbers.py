"""Packet traces from a capture of the receiver's end: the datagrams have sequence numbers."""

import re
from array import array
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.protocol.probe_format import ProbeKind, decode_probe
from noack.traces.capture_flows import CaptureFlows
from noack.traces.packet_trace import Int64s, PacketTrace, packet_trace
from noack.traces.relative_delay import envelope_slope, relative_delays
from noack.traces.udp_headers import CapturedFlow

_FIELD = re.compile(r"([0-9]{1,5}):([1-8])(:little)?")
_MOST = 2**62


class SequenceField(NamedTuple):
    """Where a payload has its sequence number."""

    offset: int
    size_bytes: int
    is_little: bool

    @classmethod
    def parse(cls, text: str) -> "SequenceField":
        """Parse ``OFFSET:BYTES`` or ``OFFSET:BYTES:little``; raise ValueError if it is neither."""
        found = _FIELD.fullmatch(text)
        if found is None:
            raise ValueError(
                f"expected OFFSET:BYTES with 1 to 8 bytes, e.g. 2:2 for RTP, or 8:4:little; "
                f"found {text!r}"
            )
        return cls(int(found[1]), int(found[2]), found[3] is not None)

    def read(self, payload: bytes) -> int | None:
        """Return the number; None if the payload is too short."""
        part = payload[self.offset : self.offset + self.size_bytes]
        if len(part) < self.size_bytes:
            return None
        return int.from_bytes(part, "little" if self.is_little else "big")


class _Numbered(NamedTuple):
    number: Int64s
    received_ns: Int64s
    sent_ns: Int64s


def _numbered(
    flows: CaptureFlows, flow: CapturedFlow, read: Callable[[bytes], tuple[int, int] | None]
) -> _Numbered:
    """Return the numbers, times of arrival and of sending of a flow, and check its direction."""
    columns = array("q"), array("q"), array("q")
    outbound = 0
    for datagram in flows.datagrams():
        if datagram.flow == flow and (found := read(datagram.payload)) is not None:
            outbound += datagram.is_outbound
            values = found[0], datagram.t_ns, found[1]
            for column, value in zip(columns, values, strict=True):
                column.append(value)
    if columns[0] and outbound == len(columns[0]):
        raise ValueError(
            "shows the sender's end only, where nothing is lost yet; capture at the receiver, or "
            "give the captures of both ends"
        )
    return _Numbered(*map(np.array, columns))


def _first_of_each(found: _Numbered, notes: list[str]) -> _Numbered:
    order = np.lexsort((found.received_ns, found.number))
    number = found.number[order]
    first = order[np.flatnonzero(np.diff(number, prepend=number[0] - 1))]
    if len(first) < len(order):
        notes.append(f"duplicates: {len(order) - len(first)}; the first counts")
    return _Numbered(*(column[first] for column in found))


def trace_of_probe(
    flows: CaptureFlows, flow: CapturedFlow, most_packets: int, notes: list[str]
) -> PacketTrace:
    """Return the trace of a probe of `noack measure`: the datagrams have their sending times."""
    sessions: Counter[int] = Counter()

    def read(payload: bytes) -> tuple[int, int] | None:
        try:
            content = decode_probe(payload)
        except ValueError:
            return None
        if content.kind not in (ProbeKind.PROBE, ProbeKind.REQUEST):
            return None
        sessions[content.session] += 1
        return content.sequence, content.sent_ns

    found = _numbered(flows, flow, read)
    if not len(found.number):
        raise ValueError(
            "has one end only, and no datagrams of `noack measure`; give the captures of both "
            "ends, or say where the payload has a sequence number: --sequence-at OFFSET:BYTES"
        )
    if len(sessions) > 1:
        raise ValueError(f"the flow has {len(sessions)} probes; capture them one by one")
    found = _first_of_each(found, notes)
    trace = packet_trace(
        found.sent_ns, found.received_ns, np.zeros(len(found.number), bool), found.number,
        clocks_differ=True, most_packets=most_packets,
    )  # fmt: skip
    return relative_delays(trace)


def trace_of_numbers(
    flows: CaptureFlows,
    flow: CapturedFlow,
    field: SequenceField,
    most_packets: int,
    notes: list[str],
) -> PacketTrace:
    """Return the trace of a sender with a constant period; the payloads have a number each."""
    bits = 8 * field.size_bytes

    def read(payload: bytes) -> tuple[int, int] | None:
        number = field.read(payload)
        return None if number is None or number >= _MOST else (number, 0)

    found = _numbered(flows, flow, read)
    if len(found.number) < 2:
        raise ValueError(
            f"fewer than two datagrams have a sequence number at {field.offset}:{field.size_bytes}"
        )
    order = np.argsort(found.received_ns, kind="stable")
    number = _unwrapped(found.number[order], bits)
    found = _first_of_each(
        found._replace(number=number, received_ns=found.received_ns[order]), notes
    )
    k, received_ns = found.number - found.number[0], found.received_ns - found.received_ns.min()
    if k[-1] >= most_packets:
        raise ValueError(
            f"the sequence numbers span {k[-1] + 1} packets; at most {most_packets} can "
            "be; check --sequence-at"
        )
    period_ns = max(envelope_slope(k, received_ns), 0.0)
    sent_ns = np.rint(period_ns * k).astype(np.int64)
    notes.append(
        f"the capture has no sending times: the sender's period is assumed to be constant, "
        f"{period_ns / 1e6:.6g} ms (lower envelope of the arrivals); delays are relative"
    )
    return packet_trace(
        sent_ns, received_ns, np.zeros(len(k), bool), found.number,
        clocks_differ=True, most_packets=most_packets,
    )  # fmt: skip


def _unwrapped(number: Int64s, bits: int) -> NDArray[np.int64]:
    """Return numbers in the order of arrival without wrap-around; ``bits`` is the field's size."""
    if bits > 32:
        return number
    half = 1 << bits - 1
    steps = (np.diff(number) + half) % (1 << bits) - half
    return np.concatenate((number[:1], number[0] + np.cumsum(steps)))
