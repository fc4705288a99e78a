"""The attacker's process: ``python -m tests.attacks.sender`` reads its plan from standard input.

It sends each kind to each port in turn, at a steady rate. It prints as JSON the numbers of
datagrams sent, by role, sender, kind and expected rejection reason.
"""

import json
import random
import socket
import struct
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass

from noack.protocol.wire_format import Flow
from noack.runtime.udp_sockets import LOOPBACK
from tests.attacks.kinds import FROM_ANYWHERE, FROM_THE_PEER, Expected, Make, Target

STRANGER, PEER = "stranger", "forged address"
_MADE_UP_FOR_S = 0.02
_DISTINCT = 5000
"""Number of distinct datagrams per kind, sender and port; making them takes time."""
_UDP_HEADER = struct.Struct("!HHHH")


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
    seed: int = 1

    def dumps(self) -> str:
        """Return the plan as JSON; it contains the run's key, so pass it on standard input only."""
        targets = [target._asdict() | {"key": target.key.hex()} for target in self.targets]
        return json.dumps(asdict(self) | {"targets": targets})


def plan_from(text: str) -> Plan:
    """Parse a plan from JSON."""
    fields = json.loads(text)
    fields["targets"] = [
        Target(**entry | {"key": bytes.fromhex(entry["key"]), "flow": Flow(entry["flow"])})
        for entry in fields["targets"]
    ]
    return Plan(**fields)


class _Sender:
    """Sends from its own address or, if permitted, from a peer's address."""

    def __init__(self, forge_addresses: bool) -> None:
        self._plain = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(4)]
        raw = (socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_UDP)
        self._raw = socket.socket(*raw) if forge_addresses else None

    def send(self, target: Target, sender: str, number: int, data: bytes) -> None:
        if sender == STRANGER:
            self._plain[number % 4].sendto(data, (LOOPBACK, target.port))
            return
        assert self._raw is not None
        size = _UDP_HEADER.size + len(data)
        header = _UDP_HEADER.pack(target.peer_port, target.port, size, 0)
        self._raw.sendto(header + data, (LOOPBACK, target.port))


class _Arm:
    """A kind of datagram, its sender and its target."""

    def __init__(self, target: Target, sender: str, kind: str, make: Make, draw: random.Random):
        self.target, self.sender, self.kind = target, sender, kind
        self._make, self._draw = make, draw
        self._expected = Expected(target)
        self._made: list[tuple[bytes, str]] = []
        self._turn = 0

    def next(self) -> tuple[bytes, str]:
        """Return a datagram and its rejection reason; datagrams repeat after ``_DISTINCT``."""
        self._turn = (self._turn + 1) % _DISTINCT
        if len(self._made) < _DISTINCT:
            data = self._make(self.target, self._draw)
            reason = self._expected.reason(data, from_peer=self.sender == PEER)
            self._made.append((data, reason.value))
            return self._made[-1]
        return self._made[self._turn]


def _arms(target: Target, forge_addresses: bool, draw: random.Random) -> list[_Arm]:
    arms = [_Arm(target, STRANGER, kind, make, draw) for kind, make in FROM_ANYWHERE.items()]
    if forge_addresses and target.role != "netem":  # the emulator accepts the sensor's address
        arms += [_Arm(target, PEER, kind, make, draw) for kind, make in FROM_THE_PEER.items()]
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
        due_s = max(due_s, now_s - _MADE_UP_FOR_S)
        yield number
        due_s += 1 / rate_hz


def carry_out(plan: Plan) -> dict[str, dict[str, dict[str, dict[str, int]]]]:
    """Attack; return the numbers sent, by role, sender, kind and expected rejection reason."""
    draw, sender = random.Random(plan.seed), _Sender(plan.forge_addresses)
    every = [_arms(target, plan.forge_addresses, draw) for target in plan.targets]
    sent: Counter[tuple[str, str, str, str]] = Counter()
    for number in _paced(plan.per_port, plan.rate_hz, plan.until_s):
        for arms in every:
            arm = arms[number % len(arms)]
            data, reason = arm.next()
            sender.send(arm.target, arm.sender, number, data)
            sent[arm.target.role, arm.sender, arm.kind, reason] += 1
    found: dict[str, dict[str, dict[str, dict[str, int]]]] = {}
    for (role, who, kind, reason), n in sent.items():
        found.setdefault(role, {}).setdefault(who, {}).setdefault(kind, {})[reason] = n
    return found


if __name__ == "__main__":
    print(json.dumps(carry_out(plan_from(sys.stdin.read()))))
