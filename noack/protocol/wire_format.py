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
flow or loop. Content is read only after the tag was verified. The core (native/wire.c) reads and
writes datagrams; :mod:`noack.protocol.datagram_seal` encrypts them.
"""

import struct
from enum import IntEnum, StrEnum
from typing import Any, NamedTuple

import numpy as np

from noack.core.core_library import core, ffi
from noack.core.linear_systems import Vector
from noack.protocol.datagram_seal import TAG_BYTES, EncryptedSeal, require_key

MAGIC = b"NA"
VERSION = 1
VERSIONS = VERSION, EncryptedSeal.version
MAX_DIMENSION = 64
MAX_LOOPS = 65_535
TIMES_NS = 2**62
"""Upper limit of times: sums of two fit the record's columns."""
_HEADER = struct.Struct("<2sBBHHQQq")
HEADER_ROW = np.dtype(
    [
        ("magic", "S2"), ("version", "u1"), ("flow", "u1"), ("dimension", "<u2"), ("loop", "<u2"),
        ("run_id", "<u8"), ("sequence", "<u8"), ("t_ns", "<i8"),
    ]
)  # fmt: skip
"""The same as a row of an array."""
HEADER_BYTES = _HEADER.size
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


def loop_number(datagram: bytes) -> int | None:
    """The loop field of a datagram, unverified; None if the datagram is too short."""
    return datagram[6] | datagram[7] << 8 if len(datagram) >= HEADER_BYTES else None


class Wire:
    """What the datagrams of a run have in common: its number, and its secret key of 32 bytes.

    Raises:
        ValueError: the key has another length.
    """

    def __init__(self, run_id: int, key: bytes, *, encrypted: bool = False) -> None:
        require_key(key)
        self.core = ffi.new(
            "noack_wire *", {"run_id": _signed(run_id), "encrypted": int(encrypted)}
        )
        core.noack_wire_key(self.core, key)
        self.seal = EncryptedSeal(key) if encrypted else None
        """What encrypts and decrypts."""


class Encoder:
    """Turns messages into datagrams of one run, under its secret key of 32 bytes."""

    def __init__(self, run_id: int, key: bytes, *, encrypted: bool = False) -> None:
        self._wire = Wire(run_id, key, encrypted=encrypted)
        self._message = ffi.new("noack_message *")
        self._datagram = ffi.new("uint8_t[]", MAX_DATAGRAM_BYTES)

    def encode(self, message: Message) -> bytes:
        """Return the datagram of a message; raise ValueError if a value does not fit."""
        vector = np.asarray(message.vector, np.float64)
        if message.flow is Flow.ACKNOWLEDGEMENT:
            if vector.size:
                raise ValueError(f"an acknowledgement carries no vector of shape {vector.shape}")
        elif vector.ndim != 1 or not 1 <= vector.size <= MAX_DIMENSION:
            raise ValueError(
                f"a datagram carries a vector of 1 to {MAX_DIMENSION} entries, "
                f"not shape {vector.shape}"
            )
        own = self._message
        try:
            if not 0 <= message.loop <= MAX_LOOPS:
                raise OverflowError(f"loop {message.loop}")
            own.flow, own.loop, own.t_ns = message.flow, message.loop, message.t_ns
            own.sequence = _signed(message.sequence)
        except OverflowError as error:
            raise ValueError(f"a number does not fit its field: {error}") from None
        own.entries = vector.size
        own.vector[0 : vector.size] = vector.tolist()
        size_bytes = core.noack_wire_encode(self._wire.core, own, self._datagram)
        datagram = bytes(ffi.buffer(self._datagram, size_bytes))
        if self._wire.seal is None:
            return datagram
        return self._wire.seal.close(datagram[:HEADER_BYTES], datagram[HEADER_BYTES:-TAG_BYTES])


def rejected_of(reception: Any) -> dict[Rejection, int]:
    """Return the number of datagrams that a ``noack_reception`` rejected, by reason."""
    return dict(zip(Rejection, reception.rejected, strict=True))


def reception_report(reception: Any) -> dict[str, object]:
    """Return the counters of a ``noack_reception`` for the run's summary."""
    rejected = {reason.value: n for reason, n in rejected_of(reception).items() if n}
    return {"accepted": reception.accepted, "rejected": rejected}


def _signed(number: int) -> int:
    """Return the signed number with the bits of an unsigned one of 64 bits."""
    return int.from_bytes(number.to_bytes(8, "little"), "little", signed=True)
