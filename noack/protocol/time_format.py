"""The datagrams with which a process compares its clock with the reference's.

Layout, version 1, little endian. Request and reply have the same size, so that a forged source
address gains no traffic::

    offset  size  field
         0     2  magic, the bytes "NC"
         2     1  version, 1
         3     1  kind: 1 request, 2 reply
         4     4  reserved, 0
         8    16  nonce: random in a request, repeated in its reply
        24     8  number of the reference's clock; 0 in a request
        32     8  time of the request's arrival, ns of the reference's clock; 0 in a request
        40     8  time of sending the reply, ns of the same clock; 0 in a request
        48    16  tag: keyed BLAKE2b over all that precedes it

The magic bytes differ from those of the loop's datagrams, so that none passes for the other under
the same key. The own sending time is not in the datagram: the client keeps it.
"""

import hmac
import struct
from enum import IntEnum
from typing import NamedTuple

from noack.protocol.datagram_seal import TAG_BYTES, Tagger
from noack.protocol.wire_format import TIMES_NS, Rejection

MAGIC = b"NC"
VERSION = 1
NONCE_BYTES = 16
_CONTENT = struct.Struct("<2sBBI16sQqq")
TIME_BYTES = _CONTENT.size + TAG_BYTES


class TimeKind(IntEnum):
    """What a datagram is."""

    REQUEST = 1
    REPLY = 2


class TimeDatagram(NamedTuple):
    """The content of a datagram."""

    kind: TimeKind
    nonce: bytes
    clock: int = 0
    received_ns: int = 0
    sent_ns: int = 0


class TimeFormat:
    """Encodes and decodes datagrams under a key of 32 bytes."""

    def __init__(self, key: bytes) -> None:
        self._tag = Tagger(key)

    def encode(self, content: TimeDatagram) -> bytes:
        """Return the datagram."""
        kind, *fields = content
        packed = _CONTENT.pack(MAGIC, VERSION, kind, 0, *fields)
        return packed + self._tag(packed)

    def decode(self, datagram: bytes, kind: TimeKind) -> TimeDatagram | Rejection:
        """Return the content of a datagram of this kind, or why it is rejected."""
        if len(datagram) != TIME_BYTES:
            return Rejection.LENGTH
        magic, version, found, reserved, nonce, clock, received_ns, sent_ns = _CONTENT.unpack_from(
            datagram
        )
        if magic != MAGIC or version != VERSION:
            return Rejection.VERSION
        if found != kind:
            return Rejection.FLOW
        if not hmac.compare_digest(self._tag(datagram[:-TAG_BYTES]), datagram[-TAG_BYTES:]):
            return Rejection.TAG
        if reserved or not 0 <= received_ns <= sent_ns < TIMES_NS:
            return Rejection.RANGE
        return TimeDatagram(kind, nonce, clock, received_ns, sent_ns)
