"""Hostile datagrams: one function per kind; no process may accept its datagrams.

The attacker has the run's ports and id. To replay and misdirect datagrams, it also has the key.
"""

import random
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from noack.protocol.wire_format import (
    HEADER_BYTES,
    KEY_BYTES,
    TAG_BYTES,
    Encoder,
    Flow,
    Message,
    Rejection,
)
from noack.runtime.address import LOOPBACK
from tests.wire_decoder import Decoder

FUTURE = 2**40
"""A sequence number that no run reaches: greater than every accepted number."""
REPLAYED = 0
"""The sequence number of replayed datagrams; it was accepted before an attack begins."""


class Target(NamedTuple):
    """A process under attack."""

    role: str
    port: int
    peer_port: int
    """The port from which its peer sends."""
    flow: Flow
    """The flow that it receives."""
    dimension: int
    run_id: int
    key: bytes
    host: str = LOOPBACK
    is_forgeable: bool = True
    """Whether a raw socket of the attacker sends from its peer's host."""


Make = Callable[[Target, random.Random], bytes]


def _authentic(
    target: Target, draw: random.Random, *, sequence: int | None = None, flow: Flow | None = None,
    run_id: int | None = None, key: bytes | None = None,
) -> bytes:  # fmt: skip
    message = Message(
        target.flow if flow is None else flow,
        FUTURE + draw.getrandbits(20) if sequence is None else sequence,
        draw.getrandbits(32),  # within the run
        np.array([draw.gauss(0, 1e6) for _ in range(target.dimension)]),
    )
    encoder = Encoder(
        target.run_id if run_id is None else run_id, target.key if key is None else key
    )
    return encoder.encode(message)


def empty(target: Target, draw: random.Random) -> bytes:
    """An empty datagram."""
    return b""


def noise(target: Target, draw: random.Random) -> bytes:
    """Random bytes, often of the right length."""
    right = HEADER_BYTES + 8 * target.dimension + TAG_BYTES
    return draw.randbytes(draw.choice((right, draw.randrange(1, 1400))))


def forged(target: Target, draw: random.Random) -> bytes:
    """A correct header, random values, a guessed tag."""
    return _authentic(target, draw)[:-TAG_BYTES] + draw.randbytes(TAG_BYTES)


def flipped(target: Target, draw: random.Random) -> bytes:
    """An authentic datagram with one bit flipped."""
    data = bytearray(_authentic(target, draw))
    bit = draw.randrange(8 * len(data))
    data[bit // 8] ^= 1 << bit % 8
    return bytes(data)


def truncated(target: Target, draw: random.Random) -> bytes:
    """The beginning of an authentic datagram."""
    data = _authentic(target, draw)
    return data[: draw.randrange(len(data))]


def oversized(target: Target, draw: random.Random) -> bytes:
    """An authentic datagram with additional bytes."""
    return _authentic(target, draw) + bytes(draw.choice((1, 8, 1000, 60_000)))


def replayed(target: Target, draw: random.Random) -> bytes:
    """An authentic datagram that was accepted before."""
    return _authentic(target, draw, sequence=REPLAYED)


def cross_run(target: Target, draw: random.Random) -> bytes:
    """A datagram of another run: another id, another key, or both."""
    other_id, other_key = draw.getrandbits(64), draw.randbytes(KEY_BYTES)
    which = draw.randrange(3)
    return _authentic(
        target, draw,
        run_id=other_id if which != 1 else None,
        key=other_key if which != 0 else None,
    )  # fmt: skip


def cross_flow(target: Target, draw: random.Random) -> bytes:
    """An authentic datagram of a flow to another process."""
    flows = [flow for flow in Flow if flow not in (target.flow, Flow.ACKNOWLEDGEMENT)]
    return _authentic(target, draw, flow=draw.choice(flows))


def elsewhere(target: Target, draw: random.Random) -> bytes:
    """An authentic datagram, newer than all others, not from the peer's address."""
    return _authentic(target, draw)


FROM_ANYWHERE: Mapping[str, Make] = {
    make.__name__: make
    for make in (
        empty, noise, forged, flipped, truncated,
        oversized, replayed, cross_run, cross_flow, elsewhere,
    )
}  # fmt: skip
FROM_THE_PEER: Mapping[str, Make] = {
    name: make for name, make in FROM_ANYWHERE.items() if make is not elsewhere
}
"""Kinds for the peer's address; with address and key, a sender cannot be told from the peer."""


class Expected:
    """The reason for which a target rejects a datagram; the network emulator rejects unknown
    sources by their address alone."""

    def __init__(self, target: Target) -> None:
        self._target = target
        self._decoder = Decoder(target.flow, target.dimension, target.run_id, target.key)
        assert self._decoder.decode(replayed(target, random.Random(0))) is not None

    def reason(self, data: bytes, *, from_peer: bool) -> Rejection:
        """Return the rejection reason.

        Raises:
            AssertionError: the target would accept the datagram.
        """
        if self._target.role == "netem":
            assert not from_peer
            return Rejection.SOURCE
        before = dict(self._decoder.rejected)
        assert self._decoder.decode(data, from_peer=from_peer) is None
        (reason,) = (r for r, n in self._decoder.rejected.items() if n != before[r])
        return reason
