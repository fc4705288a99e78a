"""Hostile datagrams, one function per kind; the attacker sends each kind to each port in turn."""

import random
import socket
import struct
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from netem.core.address import LOOPBACK
from noack.protocol.wire_format import HEADER_BYTES, KEY_BYTES, TAG_BYTES, Encoder, Flow, Message
from tests.helpers.two_hosts import enter_namespace

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
    target: Target, rng: random.Random, *, sequence: int | None = None, flow: Flow | None = None,
    run_id: int | None = None, key: bytes | None = None,
) -> bytes:  # fmt: skip
    message = Message(
        target.flow if flow is None else flow,
        FUTURE + rng.getrandbits(20) if sequence is None else sequence,
        rng.getrandbits(32),  # within the run
        np.array([rng.gauss(0, 1e6) for _ in range(target.dimension)]),
    )
    encoder = Encoder(target.run_id if run_id is None else run_id, target.key if key is None else key)
    return encoder.encode(message)


def empty(target: Target, rng: random.Random) -> bytes:
    """An empty datagram."""
    return b""


def noise(target: Target, rng: random.Random) -> bytes:
    """Random bytes, often of the right length."""
    right = HEADER_BYTES + 8 * target.dimension + TAG_BYTES
    return rng.randbytes(rng.choice((right, rng.randrange(1, 1400))))


def forged(target: Target, rng: random.Random) -> bytes:
    """A correct header, random values, a guessed tag."""
    return _authentic(target, rng)[:-TAG_BYTES] + rng.randbytes(TAG_BYTES)


def flipped(target: Target, rng: random.Random) -> bytes:
    """An authentic datagram with one bit flipped."""
    data = bytearray(_authentic(target, rng))
    bit = rng.randrange(8 * len(data))
    data[bit // 8] ^= 1 << bit % 8
    return bytes(data)


def truncated(target: Target, rng: random.Random) -> bytes:
    """The beginning of an authentic datagram."""
    data = _authentic(target, rng)
    return data[: rng.randrange(len(data))]


def oversized(target: Target, rng: random.Random) -> bytes:
    """An authentic datagram with additional bytes."""
    return _authentic(target, rng) + bytes(rng.choice((1, 8, 1000, 60_000)))


def replayed(target: Target, rng: random.Random) -> bytes:
    """An authentic datagram that was accepted before."""
    return _authentic(target, rng, sequence=REPLAYED)


def cross_run(target: Target, rng: random.Random) -> bytes:
    """A datagram of another run: another id, another key, or both."""
    other_id, other_key = rng.getrandbits(64), rng.randbytes(KEY_BYTES)
    which = rng.randrange(3)
    return _authentic(
        target, rng,
        run_id=other_id if which != 1 else None,
        key=other_key if which != 0 else None,
    )  # fmt: skip


def cross_flow(target: Target, rng: random.Random) -> bytes:
    """An authentic datagram of a flow to another process."""
    flows = [flow for flow in Flow if flow not in (target.flow, Flow.ACKNOWLEDGEMENT)]
    return _authentic(target, rng, flow=rng.choice(flows))


def elsewhere(target: Target, rng: random.Random) -> bytes:
    """An authentic datagram, newer than all others, not from the peer's address."""
    return _authentic(target, rng)


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


STRANGER, PEER = "stranger", "forged address"
_LONGEST_BURST_S = 0.02
_DISTINCT = 5000
"""Number of distinct datagrams per kind, sender and port."""
_UDP_HEADER = struct.Struct("!HHHH")

Sent = Counter[tuple[str, str, str]]
"""Numbers of datagrams by role, sender and kind."""


@dataclass(frozen=True)
class Plan:
    """An attack."""

    targets: Sequence[Target]
    per_port: int
    rate_hz: float
    """Datagrams per second to each port."""
    forge_addresses: bool
    namespace: str | None = None
    """Network namespace of the attacker."""


class _Sender:
    """Sends from its own address or, if permitted, from a peer's address."""

    def __init__(self, forge_addresses: bool) -> None:
        self._plain = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(4)]
        raw = (socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_UDP)
        self._raw = socket.socket(*raw) if forge_addresses else None

    def send(self, target: Target, sender: str, number: int, data: bytes) -> None:
        if sender == STRANGER:
            self._plain[number % 4].sendto(data, (target.host, target.port))
            return
        assert self._raw is not None
        size = _UDP_HEADER.size + len(data)
        header = _UDP_HEADER.pack(target.peer_port, target.port, size, 0)
        self._raw.sendto(header + data, (target.host, target.port))


def _datagrams(make: Make, target: Target, rng: random.Random) -> Iterator[bytes]:
    """Yield datagrams of a kind; some repeat, because making them takes time."""
    made: list[bytes] = []
    while True:
        if len(made) < _DISTINCT:
            made.append(make(target, rng))
        yield made[-1] if len(made) < _DISTINCT else rng.choice(made)


def _paced(count: int, rate_hz: float) -> Iterator[int]:
    """Count at a steady rate; after a long stall, do not catch up in one burst."""
    due_s = time.monotonic()
    for number in range(count):
        now_s = time.monotonic()
        if due_s > now_s:
            time.sleep(due_s - now_s)
        due_s = max(due_s, now_s - _LONGEST_BURST_S)
        yield number
        due_s += 1 / rate_hz


def carry_out(plan: Plan) -> Sent:
    """Attack; return the numbers of datagrams."""
    if plan.namespace is not None:
        enter_namespace(plan.namespace)
    rng, sender, sent = random.Random(1), _Sender(plan.forge_addresses), Sent()
    arms: list[list[tuple[str, str, Iterator[bytes]]]] = []
    for target in plan.targets:
        kinds = [(STRANGER, kind) for kind in FROM_ANYWHERE]
        # The emulator accepts the sensor's address.
        if plan.forge_addresses and target.is_forgeable and target.role != "netem":
            kinds += [(PEER, kind) for kind in FROM_THE_PEER]
        arms.append([(by, kind, _datagrams(FROM_ANYWHERE[kind], target, rng)) for by, kind in kinds])
    for number in _paced(plan.per_port, plan.rate_hz):
        for target, of_target in zip(plan.targets, arms, strict=True):
            by, kind, datagrams = of_target[number % len(of_target)]
            sender.send(target, by, number, next(datagrams))
            sent[target.role, by, kind] += 1
    return sent
