"""The datagrams of `noack measure`: a live probe sends them, and the reader of captures reads them.

Layout, version 1, little endian; a datagram is padded with zeros to the size that the user chose::

    offset  size  field
         0     4  magic, the bytes "NAMP"
         4     1  version, 1
         5     1  kind, see :class:`ProbeKind`
         6     2  reserved, 0
         8     4  CRC-32 of all other bytes
        12     8  session, a random number
        20     8  host: number of the sender's machine since its last boot
        28     8  sequence number, from 0; an END: number of sent datagrams
        36     8  time of sending, signed, ns of the sender's monotonic clock; repeated in an answer
        44     8  scheduled time of sequence number 0, signed, ns of the same clock
        52     8  period, ns
        60     8  planned number of datagrams; 0: until the sender is stopped
        68     8  ANSWER: number of the answer, from 0; END: late sends; END_ANSWER: sent answers
        76     8  ANSWER: newest sequence number that has arrived; END: longest lateness in ns
        84    16  ANSWER: bit i is set if the newest sequence number minus i has arrived
"""

import struct
import zlib
from enum import IntEnum
from typing import NamedTuple

MAGIC = b"NAMP"
VERSION = 1
SEEN_BITS = 128
"""Earlier sequence numbers of which an answer says whether they have arrived."""
SHORTEST_PERIOD_NS = 50_000
"""20,000 datagrams a second."""
LONGEST_PERIOD_NS = 3600 * 10**9
MAX_PROBES = 50_000_000
_LATEST_NS = 2**62
"""Upper limit of times and numbers: sums of two fit 64 bits."""
_BEFORE_CRC = struct.Struct("<4sBBH")
_CRC = struct.Struct("<I")
_BODY = struct.Struct("<QQQqqQQQQ16s")
_BODY_AT = _BEFORE_CRC.size + _CRC.size
PROBE_BYTES = _BODY_AT + _BODY.size
MAX_PROBE_BYTES = 65_507
"""Largest payload of a UDP datagram over IPv4."""


class ProbeKind(IntEnum):
    """Kinds of datagrams of the prober."""

    PROBE = 1
    """One way: it is not answered."""
    REQUEST = 2
    """Is answered."""
    ANSWER = 3
    END = 4
    """The sender has sent all; repeated."""
    END_ANSWER = 5
    """The END of a round-trip probe has arrived."""


class ProbeDatagram(NamedTuple):
    """A datagram's content."""

    kind: ProbeKind
    session: int
    host: int
    sequence: int
    sent_ns: int
    start_ns: int
    period_ns: int
    planned: int
    number: int = 0
    newest: int = 0
    seen: int = 0

    def scheduled_ns(self, sequence: int) -> int:
        """Return the scheduled sending time of a sequence number."""
        return self.start_ns + sequence * self.period_ns


def encode_probe(content: ProbeDatagram, size_bytes: int = PROBE_BYTES) -> bytes:
    """Return the datagram, padded to ``size_bytes``."""
    kind, *numbers, seen_bits = content
    begin = _BEFORE_CRC.pack(MAGIC, VERSION, kind, 0)
    body = _BODY.pack(*numbers, seen_bits.to_bytes(16, "little"))
    checked = body.ljust(size_bytes - _BODY_AT, b"\0")
    return begin + _CRC.pack(zlib.crc32(checked, zlib.crc32(begin))) + checked


def decode_probe(data: bytes) -> ProbeDatagram:
    """Return the content of a datagram.

    Raises:
        ValueError: it is not one of the prober's; the message is one word: ``foreign``,
            ``version``, ``corrupted`` or ``impossible``.
    """
    if len(data) < PROBE_BYTES or data[:4] != MAGIC:
        raise ValueError("foreign")
    _, version, kind, reserved = _BEFORE_CRC.unpack_from(data)
    if version != VERSION:
        raise ValueError("version")
    (crc,) = _CRC.unpack_from(data, _BEFORE_CRC.size)
    if crc != zlib.crc32(data[_BODY_AT:], zlib.crc32(data[: _BEFORE_CRC.size])):
        raise ValueError("corrupted")
    fields = _BODY.unpack_from(data, _BODY_AT)
    if reserved or kind not in ProbeKind.__members__.values():
        raise ValueError("impossible")
    probe = ProbeDatagram._make((ProbeKind(kind), *fields[:-1], int.from_bytes(fields[-1], "little")))
    possible = (
        probe.sequence <= MAX_PROBES
        and probe.planned <= MAX_PROBES
        and probe.number <= _LATEST_NS
        and probe.newest <= _LATEST_NS
        and SHORTEST_PERIOD_NS <= probe.period_ns <= LONGEST_PERIOD_NS
        and abs(probe.start_ns) <= _LATEST_NS
        and abs(probe.sent_ns) <= _LATEST_NS
        and (kind == ProbeKind.END or probe.sent_ns >= probe.scheduled_ns(probe.sequence))
    )
    if not possible:
        raise ValueError("impossible")
    return probe
