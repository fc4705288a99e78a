"""Datagrams, and a receiver of one flow of a loop, written from docs/wire.md alone."""

import hashlib
import math
import struct
from collections.abc import Sequence
from typing import Any

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

from noack.protocol.wire_format import Flow, Message, Rejection
from tests.helpers.wire_decoder import Decoder

KEY = bytes(range(32))
"""The key of all published datagrams."""
TIMES_NS = 2**62
"""Times are below."""
RUN = 0x0123_4567_89AB_CDEF
ACCEPTED = "accepted"


def tag(content: bytes, key: bytes = KEY) -> bytes:
    """Return the tag of version 1."""
    return hashlib.blake2b(content, key=key, digest_size=16).digest()


def seal(key: bytes) -> ChaCha20Poly1305:
    """Return what encrypts datagrams of version 2."""
    return ChaCha20Poly1305(hashlib.blake2b(b"noack datagrams", key=key, digest_size=32).digest())


def nonce(flow: int, loop: int, sequence: int) -> bytes:
    return struct.pack("<BBHQ", flow, 0, loop, sequence)


def datagram(
    values: Sequence[float],
    *,
    magic: bytes = b"NA",
    version: int = 1,
    flow: int = 2,
    dimension: int | None = None,
    error_level: int = 0,
    loop: int = 0,
    run_id: int = RUN,
    sequence: int = 0,
    t_ns: int = 0,
    key: bytes = KEY,
) -> bytes:
    """Return a datagram with a valid tag under ``key``; by default, the dimension is that of ``values``."""
    entries = len(values) if dimension is None else dimension
    header = struct.pack(
        "<2sBBBBHQQq", magic, version, flow, entries, error_level, loop, run_id, sequence, t_ns
    )
    vector = struct.pack(f"<{len(values)}d", *values)
    if version == 2:
        return header + seal(key).encrypt(nonce(flow, loop, sequence), vector, header)
    return header + vector + tag(header + vector, key)


class Receiver:
    """Accepts datagrams of one flow.

    Args:
        key: the key of the run.
        version: 1, or 2 for encrypted datagrams.
        flow: number of the flow.
        dimension: number of entries of a vector.
        run_id: number of the run.
        loop: number of the loop.
        not_after_ns: time of the last datagram.
    """

    def __init__(
        self, key: bytes, *, version: int, flow: int, dimension: int, run_id: int, loop: int,
        not_after_ns: int,
    ) -> None:  # fmt: skip
        self._key, self._version, self._flow, self._dimension = key, version, flow, dimension
        self._run_id, self._loop = run_id, loop
        self._not_after_ns = not_after_ns
        self._newest = -1

    def examine(self, data: bytes, *, from_peer: bool) -> tuple[str, dict[str, Any]]:
        """Return "accepted" and the fields, or the reason of the rejection."""
        if len(data) < 32:
            return "length", {}
        magic, version, flow, n, level, loop, run_id, sequence, t_ns = struct.unpack_from("<2sBBBBHQQq", data)
        for reason, holds in (
            ("version", magic == b"NA" and version == self._version),
            ("length", n == self._dimension and len(data) == 48 + 8 * n),
            ("run", run_id == self._run_id),
            ("flow", flow == self._flow),
            ("loop", loop == self._loop),
        ):
            if not holds:
                return reason, {}
        if (content := self._opened(data, nonce(flow, loop, sequence))) is None:
            return "tag", {}
        vector = [*struct.unpack(f"<{n}d", content)]
        for reason, holds in (
            ("source", from_peer),
            ("range", sequence < 2**63 and 0 <= t_ns <= self._not_after_ns),
            ("stale", sequence > self._newest),
            ("not_finite", all(map(math.isfinite, vector))),
        ):
            if not holds:
                return reason, {}
        self._newest = sequence
        return ACCEPTED, {"sequence": sequence, "t_ns": t_ns, "error_level": level, "vector": vector}

    def _opened(self, data: bytes, nonce: bytes) -> bytes | None:
        if self._version == 1:
            return data[32:-16] if tag(data[:-16], self._key) == data[-16:] else None
        try:
            return seal(self._key).decrypt(nonce, data[32:], data[:32])
        except InvalidTag:
            return None


class BothReceivers:
    """The core's receiver and that of the page, which must agree on each datagram."""

    def __init__(
        self, flow: int = 2, dimension: int = 3, *, run_id: int = RUN, loop: int = 0, encrypted: bool = False,
        not_after_ns: int = TIMES_NS - 1,
    ) -> None:  # fmt: skip
        self.core = Decoder(
            Flow(flow), dimension, run_id, KEY, not_after_ns=not_after_ns,
            loop=loop, encrypted=encrypted,
        )  # fmt: skip
        self._page = Receiver(
            KEY, version=1 + encrypted, flow=flow, dimension=dimension, run_id=run_id, loop=loop,
            not_after_ns=not_after_ns,
        )  # fmt: skip
        self.message: Message | None = None
        """The message of the last datagram; None if it was rejected."""

    def examine(self, data: bytes, *, from_peer: bool = True) -> tuple[str, dict[str, Any]]:
        """Return what both say; each datagram is counted once."""
        accepted, rejected = self.core.accepted, dict(self.core.rejected)
        message = self.message = self.core.decode(data, from_peer=from_peer)
        result, fields = self._page.examine(data, from_peer=from_peer)
        counted = {reason: n - rejected[reason] for reason, n in self.core.rejected.items()}
        expected = dict.fromkeys(counted, 0)
        if message is None:
            expected[Rejection(result)] = 1
        else:
            vector = struct.pack(f"<{len(message.vector)}d", *fields["vector"])
            assert message.vector.tobytes() == vector
            names = ("sequence", "t_ns", "error_level")
            assert [getattr(message, name) for name in names] == [fields[name] for name in names]
        assert counted == expected
        assert self.core.accepted == accepted + (result == ACCEPTED)
        return result, fields
