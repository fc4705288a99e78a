"""The wire format of the loop: one datagram, one message.

Only the acknowledgement baseline (``network.protocol = "ack"``) acknowledges messages.

Layout, little endian (``docs/wire.md`` has test vectors)::

    offset  size  field
         0     2  magic, the bytes "NA"
         2     1  version: 1, or 2 of an encrypted datagram
         3     1  flow: 1 measurement, 2 update, 3 actuation, 4 acknowledgement
         4     1  dimension n of the vector, 1 to 64; 0 of an acknowledgement
         5     1  error level of an update; 0: unknown
         6     2  number of the loop, unsigned, 0 to 65,534; 0 in a run of one loop
         8     8  run id, unsigned
        16     8  sequence number, unsigned, from 0 within a flow; what is acknowledged
        24     8  event time, signed, nanoseconds of simulated time since the run's epoch
        32    8n  vector, float64; of version 2 encrypted
     32+8n    16  tag over all that precedes it, under the run's key

The tag covers flow, loop, run and sequence number, so that no datagram passes for one of another
flow or loop. Content is read only after the tag was verified. The core (native/loop/wire.c) reads and
writes datagrams, with their tags by keyed BLAKE2b; :class:`EncryptedSeal` encrypts them.
"""

import hashlib
from enum import IntEnum, StrEnum
from typing import NamedTuple

import numpy as np

from netem.core.core_library import CData
from noack.core.core_library import core, ffi
from noack.core.linear_systems import Vector

KEY_BYTES = 32
TAG_BYTES = 16
_PURPOSE = b"noack datagrams"
MAGIC = b"NA"
VERSION = 1
MAX_DIMENSION = 64
"""Most entries of a vector in a datagram."""
MAX_LOOPS = 65_535
"""Maximum number of loops of a run; they are numbered from 0."""
HEADER_ROW = np.dtype(
    [
        ("magic", "S2"),
        ("version", "u1"),
        ("flow", "u1"),
        ("dimension", "u1"),
        ("error_level", "u1"),
        ("loop", "<u2"),
        ("run_id", "<u8"),
        ("sequence", "<u8"),
        ("t_ns", "<i8"),
    ]
)
"""A header as a row of an array."""
HEADER_BYTES = HEADER_ROW.itemsize
MAX_DATAGRAM_BYTES = HEADER_BYTES + 8 * MAX_DIMENSION + TAG_BYTES


_FLOW, _LOOP, _SEQUENCE = slice(3, 4), slice(6, 8), slice(16, 24)  # in the header


class EncryptedSeal:
    """Layout version 2: the vector encrypted by ChaCha20-Poly1305 (RFC 8439), with its tag.

    The tag covers the header, too, which is readable. Nobody without the key can change, make or
    read what is encrypted.

    The nonce is the flow, the loop and the sequence number. No two datagrams of a run have the same
    ones.
    """

    version = 2

    def __init__(self, key: bytes) -> None:
        from cryptography.exceptions import InvalidTag  # few runs are encrypted
        from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305  # the same

        require_key(key)
        # A key of its own: the tags of other datagrams are made with the run's key itself.
        derived = hashlib.blake2b(_PURPOSE, key=key, digest_size=KEY_BYTES).digest()
        self._cipher, self._invalid = ChaCha20Poly1305(derived), InvalidTag

    def encrypt(self, header: bytes, vector: bytes) -> bytes:
        """Return the datagram with this header and vector."""
        return header + self._cipher.encrypt(_nonce_of(header), vector, header)

    def decrypt(self, datagram: bytes, header_bytes: int) -> bytes | None:
        """Return the vector of a datagram; None if it was not made under the same key."""
        header = datagram[:header_bytes]
        try:
            return self._cipher.decrypt(_nonce_of(header), datagram[header_bytes:], header)
        except self._invalid:
            return None


def _nonce_of(header: bytes) -> bytes:
    return header[_FLOW] + b"\0" + header[_LOOP] + header[_SEQUENCE]


def require_key(key: bytes) -> None:
    """Raise ValueError if a key has another length."""
    if len(key) != KEY_BYTES:
        raise ValueError(f"the run's key has {KEY_BYTES} bytes, not {len(key)}")


VERSIONS = VERSION, EncryptedSeal.version


class Flow(IntEnum):
    """The content of a datagram, which determines its sender and its receiver."""

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
    error_level: int = 0
    """Of an update: its error as a share of its threshold, on the scale of docs/wire.md; 0: unknown."""


class Rejection(StrEnum):
    """Reasons for which a datagram is counted and ignored."""

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
    error_level: int
    loop: int
    run_id: int
    sequence: int
    t_ns: int


def datagram_bytes(dimension: int) -> int:
    """Return the size of a datagram that carries a vector of ``dimension`` entries."""
    return HEADER_BYTES + 8 * dimension + TAG_BYTES


def read_header(datagram: bytes) -> Header | None:
    """Read the header of a datagram without verification; None if it is no datagram of noack."""
    if len(datagram) < HEADER_BYTES or datagram[:2] != MAGIC:
        return None
    return Header(*np.frombuffer(datagram, HEADER_ROW, 1).tolist()[0][1:])


def loop_number(datagram: bytes) -> int | None:
    """Return the loop field of a datagram, unverified; None if the datagram is too short."""
    return datagram[6] | datagram[7] << 8 if len(datagram) >= HEADER_BYTES else None


class Wire:
    """The common part of a run's datagrams: its number, and its secret key of 32 bytes.

    Raises:
        ValueError: the key has another length.
    """

    def __init__(self, run_id: int, key: bytes, *, encrypted: bool = False) -> None:
        require_key(key)
        self.core = ffi.new("noack_wire *", {"run_id": _signed(run_id), "encrypted": int(encrypted)})
        core.noack_wire_key(self.core, key)
        self.seal = EncryptedSeal(key) if encrypted else None
        """The cipher."""


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
                f"a datagram carries a vector of 1 to {MAX_DIMENSION} entries, not shape {vector.shape}"
            )
        core_message = self._message
        try:
            if not 0 <= message.loop < MAX_LOOPS:
                raise OverflowError(f"loop {message.loop}")
            core_message.flow, core_message.loop, core_message.t_ns = message.flow, message.loop, message.t_ns
            core_message.error_level = message.error_level.to_bytes(1, "little")[0]
            core_message.sequence = _signed(message.sequence)
        except OverflowError as error:
            raise ValueError(f"a number does not fit its field: {error}") from None
        core_message.entries = vector.size
        core_message.vector[0 : vector.size] = vector.tolist()
        size_bytes = core.noack_wire_encode(self._wire.core, core_message, self._datagram)
        datagram = bytes(ffi.buffer(self._datagram, size_bytes))
        if self._wire.seal is None:
            return datagram
        return self._wire.seal.encrypt(datagram[:HEADER_BYTES], datagram[HEADER_BYTES:-TAG_BYTES])


def rejected_of(reception: CData) -> dict[Rejection, int]:
    """Return the number of datagrams that a ``noack_reception`` rejected, by reason."""
    return dict(zip(Rejection, reception.rejected, strict=True))


def reception_report(reception: CData) -> dict[str, object]:
    """Return the counters of a ``noack_reception`` for the run's summary."""
    rejected = {reason.value: n for reason, n in rejected_of(reception).items() if n}
    return {"accepted": reception.accepted, "rejected": rejected}


def _signed(number: int) -> int:
    """Return the signed number with the bits of an unsigned one of 64 bits."""
    return int.from_bytes(number.to_bytes(8, "little"), "little", signed=True)
