"""The attacker: sends each kind of datagram to each port in turn, at a steady rate."""

import ctypes
import random
import socket
import struct
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.attacks.kinds import FROM_ANYWHERE, FROM_THE_PEER, Expected, Target

STRANGER, PEER = "stranger", "forged address"
_LONGEST_BURST_S = 0.02
_DISTINCT = 5000
"""Number of distinct datagrams per kind, sender and port; making them takes time."""
_CLONE_NEWNET = 0x40000000
_UDP_HEADER = struct.Struct("!HHHH")

Sent = Counter[tuple[str, str, str, str]]
"""Numbers of datagrams by role, sender, kind and expected rejection reason."""


@dataclass(frozen=True)
class Plan:
    """An attack."""

    targets: Sequence[Target]
    per_port: int
    rate_hz: float
    """Datagrams per second to each port."""
    forge_addresses: bool
    until_s: float
    """Latest end on the monotonic clock, even if datagrams are left."""
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


class _Arm:
    """A kind of datagram, its sender and its target."""

    def __init__(self, target: Target, sender: str, kind: str, draw: random.Random) -> None:
        self.target, self.sender, self.kind = target, sender, kind
        self._draw, self._expected = draw, Expected(target)
        self._made: list[tuple[bytes, str]] = []
        self._turn = 0

    def next(self) -> tuple[bytes, str]:
        """Return a datagram and its rejection reason; datagrams repeat after ``_DISTINCT``."""
        self._turn = (self._turn + 1) % _DISTINCT
        if len(self._made) == _DISTINCT:
            return self._made[self._turn]
        data = FROM_ANYWHERE[self.kind](self.target, self._draw)
        reason = self._expected.reason(data, from_peer=self.sender == PEER)
        self._made.append((data, reason.value))
        return self._made[-1]


def _arms(target: Target, forge_addresses: bool, draw: random.Random) -> list[_Arm]:
    arms = [_Arm(target, STRANGER, kind, draw) for kind in FROM_ANYWHERE]
    # The emulator accepts the sensor's address.
    if forge_addresses and target.is_forgeable and target.role != "netem":
        arms += [_Arm(target, PEER, kind, draw) for kind in FROM_THE_PEER]
    return arms


def _paced(count: int, rate_hz: float, until_s: float) -> Iterator[int]:
    """Count at a steady rate; after a long stall, do not catch up in one burst."""
    due_s = time.monotonic()
    for number in range(count):
        now_s = time.monotonic()
        if now_s > until_s:
            return
        if due_s > now_s:
            time.sleep(due_s - now_s)
        due_s = max(due_s, now_s - _LONGEST_BURST_S)
        yield number
        due_s += 1 / rate_hz


def enter_namespace(namespace: str) -> None:
    """Move this process to a network namespace."""
    with Path(f"/var/run/netns/{namespace}").open() as file:
        if ctypes.CDLL(None, use_errno=True).setns(file.fileno(), _CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), "setns failed")


def carry_out(plan: Plan) -> Sent:
    """Attack; return the numbers of datagrams."""
    if plan.namespace is not None:
        enter_namespace(plan.namespace)
    draw, sender, sent = random.Random(1), _Sender(plan.forge_addresses), Sent()
    every = [_arms(target, plan.forge_addresses, draw) for target in plan.targets]
    for number in _paced(plan.per_port, plan.rate_hz, plan.until_s):
        for arms in every:
            arm = arms[number % len(arms)]
            data, reason = arm.next()
            sender.send(arm.target, arm.sender, number, data)
            sent[arm.target.role, arm.sender, arm.kind, reason] += 1
    return sent
