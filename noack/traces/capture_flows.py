"""The UDP flows of a capture, and their datagrams as arrays."""

import hashlib
import os
from array import array
from collections import Counter
from collections.abc import Iterator
from typing import IO, NamedTuple

import numpy as np

from noack.protocol.probe_format import MAGIC
from noack.traces.capture_blocks import CutCaptureError, captured_packets
from noack.traces.packet_trace import Int64s
from noack.traces.udp_headers import CapturedFlow, udp_of

_MOST_FLOWS = 1_000_000
_KEY = os.urandom(16)
"""Payloads are compared by a keyed hash, so that nobody can make two with the same."""


class CapturedDatagram(NamedTuple):
    """A UDP datagram of a capture."""

    t_ns: int
    flow: CapturedFlow
    payload: bytes
    is_cut: bool
    """Whether only its beginning was captured."""
    is_outbound: bool


class Payloads(NamedTuple):
    """Captured datagrams, sorted by time."""

    t_ns: Int64s
    hashes: Int64s
    """Of the payloads."""
    flow: Int64s
    """Places of the flows in :attr:`CaptureFlows.names`."""


class CaptureFlows:
    """A capture that has been read once: its flows, the largest first.

    Raises:
        ValueError: it is not a capture, or has no UDP datagrams.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.notes: list[str] = []
        """Lines about the capture."""
        counts: Counter[CapturedFlow] = Counter()
        for datagram in self.datagrams(self.notes):
            counts[datagram.flow] += 1
            if len(counts) > _MOST_FLOWS:
                raise ValueError(f"has more than {_MOST_FLOWS} flows; filter the capture first")
        if not counts:
            cut = self.notes[0].partition(";")[0] if self.notes else ""
            raise ValueError(f"has no UDP datagrams{': ' if cut else ''}{cut}")
        self.names, self._counts = zip(*counts.most_common(), strict=True)

    def choose(self, number: int) -> CapturedFlow:
        """Return the flow of a number; 1 is the largest. Raise ValueError if there is none."""
        if not 1 <= number <= len(self.names):
            raise ValueError(f"has no flow {number}; its flows are 1 to {len(self.names)}")
        flow: CapturedFlow = self.names[number - 1]
        many = len(self.names)
        others = f"; --flow chooses another of the {many} flows" if many > 1 else ""
        self.notes.append(f"flow {number}: {flow}, {self._counts[number - 1]} datagrams{others}")
        return flow

    def datagrams(self, notes: list[str] | None = None) -> Iterator[CapturedDatagram]:
        """Yield the UDP datagrams, but not the last ones of a probe, which have no numbers."""
        try:
            for packet in captured_packets(self._file):
                found = udp_of(packet.interface, packet.link_type, packet.data)
                if found is None or _is_end_of_probe(found[1]):
                    continue
                flow, payload, is_complete = found
                yield CapturedDatagram(
                    packet.t_ns, flow, payload, not is_complete, packet.is_outbound
                )
        except CutCaptureError as error:
            if notes is not None:
                notes.append(f"the capture {error}; what is before is used")

    def payloads(self) -> Payloads:
        """Return all complete datagrams."""
        numbers = {flow: number for number, flow in enumerate(self.names)}
        columns = array("q"), array("q"), array("q")
        for datagram in self.datagrams():
            if not datagram.is_cut:
                digest = hashlib.blake2b(datagram.payload, digest_size=8, key=_KEY).digest()
                hashed = int.from_bytes(digest, "little", signed=True)
                values = datagram.t_ns, hashed, numbers[datagram.flow]
                for column, value in zip(columns, values, strict=True):
                    column.append(value)
        order = np.argsort(np.array(columns[0]), kind="stable")
        return Payloads(*(np.array(column)[order] for column in columns))


def _is_end_of_probe(payload: bytes) -> bool:
    return payload[:4] == MAGIC and payload[5:6] in (b"\4", b"\5")
