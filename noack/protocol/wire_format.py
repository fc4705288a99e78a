"""The wire format of the loop: one datagram, one message.

Only the acknowledgement baseline (``network.protocol = "ack"``) acknowledges messages.

Layout, little endian (``docs/wire.md`` has test vectors)::

    offset  size  field
         0     2  magic, the bytes "NA"
         2     1  version: 1, or 2 of an encrypted datagram
         3     1  flow: 1 measurement, 2 update, 3 actuation, 4 acknowledgement
         4     2  dimension n of the vector, 1 to 64; 0 of an acknowledgement
         6     2  number of the loop, unsigned, 0 to 65,534; 0 in a run of one loop
         8     8  run id, unsigned
        16     8  sequence number, unsigned, from 0 within a flow; what is acknowledged
        24     8  event time, signed, nanoseconds of simulated time since the run's epoch
        32    8n  vector, float64; of version 2 encrypted
     32+8n    16  tag over all that precedes it, under the run's key

The tag covers flow, loop, run and sequence number, so that no datagram passes for one of another
flow or loop. Content is read only after the tag was verified. Tag and encryption are in
:mod:`noack.protocol.datagram_seal`.
"""

import math
import struct
from enum import IntEnum, StrEnum
from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Vector
from noack.protocol.datagram_seal import TAG_BYTES, AuthenticatedSeal, EncryptedSeal, seal_of

MAGIC = b"NA"
VERSION = AuthenticatedSeal.version
VERSIONS = VERSION, EncryptedSeal.version
MAX_DIMENSION = 64
MAX_LOOPS = 65_535
SEQUENCES, TIMES_NS = 2**63, 2**62
"""Upper limits of sequence numbers and times: they fit the record's columns, and sums of times do
too. At 100,000 messages a second, 2⁶³ take three million years."""
_HEADER = struct.Struct("<2sBBHHQQq")
HEADER_BYTES = _HEADER.size
FLOW_OFFSET = 3
MAX_DATAGRAM_BYTES = HEADER_BYTES + 8 * MAX_DIMENSION + TAG_BYTES


class Flow(IntEnum):
    """What a datagram carries, and so between which processes."""

    MEASUREMENT = 1
    """plant → sensor: the plant state x(t_k), shape (n,); with an observer what is measured of it,
    and the inputs since the last measurement, [y; u …]."""
    UPDATE = 2
    """sensor → network → controller: the plant state at an event, x(t_i), shape (n,)."""
    ACTUATION = 3
    """controller → plant: the control input u, shape (m,)."""
    ACKNOWLEDGEMENT = 4
    """controller → network → sensor, with ``protocol = "ack"`` only: an update's sequence number
    and event time, and no vector, shape (0,)."""


NO_VECTOR: Vector = np.zeros(0)  # the vector of an acknowledgement


class Message(NamedTuple):
    """One message of the loop, decoded."""

    flow: Flow
    sequence: int
    t_ns: int
    vector: Vector
    loop: int = 0
    """The number of its loop, among the loops of its run."""


class Rejection(StrEnum):
    """Why a datagram was counted and ignored."""

    LENGTH = "length"
    VERSION = "version"
    RUN = "run"
    FLOW = "flow"
    LOOP = "loop"
    TAG = "tag"
    SOURCE = "source"
    RANGE = "range"
    STALE = "stale"
    NOT_FINITE = "not_finite"


class Header(NamedTuple):
    """The fixed part of a datagram, unverified."""

    version: int
    flow: int
    dimension: int
    loop: int
    run_id: int
    sequence: int
    t_ns: int


def datagram_bytes(dimension: int) -> int:
    """Size of a datagram that carries a vector of ``dimension`` entries."""
    return HEADER_BYTES + 8 * dimension + TAG_BYTES


def read_header(datagram: bytes) -> Header | None:
    """Read the header of a datagram without verification; None if it is no datagram of noack."""
    if len(datagram) < HEADER_BYTES or datagram[:2] != MAGIC:
        return None
    return Header(*_HEADER.unpack_from(datagram)[1:])


def flow_of(datagram: bytes) -> int | None:
    """The flow field of a datagram, unverified; None if the datagram is too short."""
    return datagram[FLOW_OFFSET] if len(datagram) >= HEADER_BYTES else None


def loop_number(datagram: bytes) -> int | None:
    """The loop field of a datagram, unverified; None if the datagram is too short."""
    return datagram[6] | datagram[7] << 8 if len(datagram) >= HEADER_BYTES else None


class Encoder:
    """Turns messages into datagrams of one run, under its secret key of 32 bytes."""

    def __init__(self, run_id: int, key: bytes, *, encrypted: bool = False) -> None:
        self._run_id = run_id
        self._seal = seal_of(key, encrypted=encrypted)

    def encode(self, message: Message) -> bytes:
        """Return the datagram of a message; raise ValueError if a value does not fit."""
        vector = np.ascontiguousarray(message.vector, dtype="<f8")
        if message.flow is Flow.ACKNOWLEDGEMENT:
            if vector.size:
                raise ValueError(f"an acknowledgement carries no vector of shape {vector.shape}")
        elif vector.ndim != 1 or not 1 <= vector.size <= MAX_DIMENSION:
            raise ValueError(
                f"a datagram carries a vector of 1 to {MAX_DIMENSION} entries, "
                f"not shape {vector.shape}"
            )
        try:
            header = _HEADER.pack(
                MAGIC, self._seal.version, message.flow, vector.size, message.loop,
                self._run_id, message.sequence, message.t_ns,
            )  # fmt: skip
        except struct.error as error:
            raise ValueError(f"a number does not fit its field: {error}") from None
        return self._seal.close(header, vector.tobytes())


class Decoder:
    """Turns the datagrams of one flow of a loop into messages; others are counted and rejected.

    Only a datagram that is newer than every one accepted before is accepted. A datagram from before
    ``not_before_ns`` is stale: the process before a restart may have accepted it.
    """

    def __init__(
        self,
        flow: Flow,
        dimension: int,
        run_id: int,
        key: bytes,
        *,
        not_before_ns: int = 0,
        loop: int = 0,
        encrypted: bool = False,
    ) -> None:
        self._flow = flow
        self._loop = loop
        self._size_bytes = datagram_bytes(dimension)
        self._dimension = dimension
        self._vector = struct.Struct(f"<{dimension}d")
        self._run_id = run_id
        self._seal = seal_of(key, encrypted=encrypted)
        self._newest = -1
        self._not_before_ns = not_before_ns
        self.accepted = 0
        self.rejected: dict[Rejection, int] = dict.fromkeys(Rejection, 0)

    def decode(self, datagram: bytes, *, from_peer: bool = True) -> Message | None:
        """Return the message, or None when the datagram was rejected (see ``rejected``).

        From any source but the peer's address even an authentic datagram is a replay.
        """
        examined = self._examine(datagram, from_peer=from_peer)
        if isinstance(examined, Rejection):
            self.rejected[examined] += 1
            return None
        self._newest = examined.sequence
        self.accepted += 1
        return examined

    def report(self) -> dict[str, object]:
        """Counters, for the run's summary."""
        rejected = {reason.value: n for reason, n in self.rejected.items() if n}
        return {"accepted": self.accepted, "rejected": rejected}

    def _examine(self, datagram: bytes, *, from_peer: bool) -> Message | Rejection:
        # Cheap tests first: they reject most invalid input and name common mistakes.
        if len(datagram) < HEADER_BYTES:
            return Rejection.LENGTH
        magic, version, flow, dimension, loop, run_id, sequence, t_ns = _HEADER.unpack_from(
            datagram
        )
        if magic != MAGIC or version != self._seal.version:
            return Rejection.VERSION
        if len(datagram) != self._size_bytes or dimension != self._dimension:
            return Rejection.LENGTH
        if run_id != self._run_id:
            return Rejection.RUN
        if flow != self._flow:
            return Rejection.FLOW
        if loop != self._loop:
            return Rejection.LOOP
        vector = self._seal.open(datagram, HEADER_BYTES)
        if vector is None:
            return Rejection.TAG
        if not from_peer:
            return Rejection.SOURCE
        if sequence >= SEQUENCES or not 0 <= t_ns < TIMES_NS:
            return Rejection.RANGE
        if sequence <= self._newest or t_ns < self._not_before_ns:
            return Rejection.STALE
        entries = self._vector.unpack(vector)
        if not all(map(math.isfinite, entries)):
            return Rejection.NOT_FINITE
        return Message(self._flow, sequence, t_ns, np.array(entries), loop)
