"""Send thousands of hostile datagrams of every kind to every port of a run; none is accepted."""

import pytest

from noack.protocol.roles import LOOP_ROLES
from tests.attacks.attacked import CHECKS, Attacked, attack, may_forge_addresses
from tests.attacks.kinds import FROM_ANYWHERE, FROM_THE_PEER, PEER, STRANGER

pytestmark = pytest.mark.live

PER_PORT = 1_500
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
        assert attacked.sent_to(role, STRANGER).keys() == FROM_ANYWHERE.keys()
        assert attacked.sent_to(role).total() > 300  # even on a busy machine


def test_datagrams_with_a_forged_peer_address_are_rejected_by_content(attacked: Attacked) -> None:
    if not may_forge_addresses():
        pytest.skip("only an administrator may send with another's address")
    forged = [role for role in LOOP_ROLES if attacked.sent_to(role, PEER)]
    assert forged == ["plant", "sensor", "controller"]
    for role in forged:
        assert attacked.sent_to(role, PEER).keys() == FROM_THE_PEER.keys()
        assert attacked.channel(role)["rejected"]["stale"] > 0
