"""Send thousands of hostile datagrams of every kind to every port of a run; none is accepted."""

import random

import pytest

from noack.protocol.topology import LOOP_ROLES
from noack.protocol.wire_format import Encoder, Flow, Message, Rejection
from tests.attacks.attacked import CHECKS, Attacked, attack, may_forge_addresses
from tests.attacks.kinds import FROM_ANYWHERE, FROM_THE_PEER, Expected, Target
from tests.attacks.sender import PEER, STRANGER
from tests.wire_decoder import Decoder

PER_PORT = 3_000
RATE_HZ = 4000.0


@pytest.fixture(scope="module")
def attacked(tmp_path_factory: pytest.TempPathFactory) -> Attacked:
    """``make attack ARGS=--hosts`` attacks a run on two hosts."""
    folder = tmp_path_factory.mktemp("attacked")
    return attack(folder, PER_PORT, RATE_HZ, forge_addresses=may_forge_addresses())


@pytest.mark.parametrize("check", CHECKS)
def test_a_run_under_attack_passes_each_check(attacked: Attacked, check: str) -> None:
    assert list(CHECKS[check](attacked)) == []


def test_every_kind_was_sent_to_every_port(attacked: Attacked) -> None:
    for role in LOOP_ROLES:
        assert attacked.kinds_sent(role, STRANGER) == FROM_ANYWHERE.keys()
        assert attacked.sent_to(role).total() > 300  # even on a busy machine


def test_datagrams_with_a_forged_peer_address_are_rejected_by_content(attacked: Attacked) -> None:
    if not may_forge_addresses():
        pytest.skip("only an administrator may send with another's address")
    forged = [role for role in LOOP_ROLES if attacked.kinds_sent(role, PEER)]
    assert forged == ["plant", "sensor", "controller"]
    for role in forged:
        assert attacked.kinds_sent(role, PEER) == FROM_THE_PEER.keys()
        assert attacked.channel(role)["rejected"]["stale"] > 0


@pytest.mark.parametrize("kind", FROM_ANYWHERE)
def test_each_kind_of_attack_is_rejected_for_its_reasons(kind: str) -> None:
    """From an unknown source and from the peer's address, with the reasons of this kind."""
    target = Target("sensor", 1, 2, Flow.MEASUREMENT, 4, 9, bytes(range(32)))
    allowed = {
        "empty": {"length"},
        "noise": {"length", "version"},
        "forged": {"tag"},
        "flipped": {"version", "length", "run", "loop", "flow", "tag"},
        "truncated": {"length"},
        "oversized": {"length"},
        "replayed": {"source", "stale"},
        "cross_run": {"run", "tag"},
        "cross_flow": {"flow"},
        "elsewhere": {"source"},
    }[kind]
    expected, draw, seen = Expected(target), random.Random(3), set()
    for _ in range(300):
        data = FROM_ANYWHERE[kind](target, draw)
        seen.add(expected.reason(data, from_peer=False))
        if kind in FROM_THE_PEER:
            seen.add(expected.reason(data, from_peer=True))
    assert seen == {Rejection(reason) for reason in allowed}


def test_a_dropped_update_can_be_delivered_late_but_not_twice_nor_after_a_newer_one() -> None:
    """The remaining ability of an attacker who sends from the network's address without a key.

    A datagram that the network dropped is authentic and was not accepted yet. An attacker with a
    copy can deliver it once, until a newer one is accepted. A network with delay can do the same.
    """
    key = bytes(range(32))
    encoder, ear = Encoder(1, key), Decoder(Flow.UPDATE, 1, 1, key)
    updates = [encoder.encode(Message(Flow.UPDATE, k, k, [float(k)])) for k in range(4)]
    assert ear.decode(updates[0]) is not None
    late = ear.decode(updates[1])  # dropped by the network, kept by the attacker
    assert late is not None
    assert late.vector.tolist() == [1.0]
    assert ear.decode(updates[1]) is None
    assert ear.decode(updates[3]) is not None
    assert ear.decode(updates[2]) is None
    assert ear.rejected[Rejection.STALE] == 2
