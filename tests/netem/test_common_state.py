"""A Gilbert–Elliott chain whose state all flows of a link share, against the chain's matrix."""

import numpy as np
import pytest

from noack.impairments.kinds.loss import LossOf
from noack.impairments.link_settings import LinkSettings
from noack.impairments.loss_models.gilbert_elliott import GilbertElliottLoss
from noack.protocol.record_tables import Fate
from tests.oracles.link import Datagram, Link

STEP_NS = 10_000_000
P, R = 0.02, 0.1


def link(**settings: float) -> Link:
    chain = GilbertElliottLoss(
        good_to_bad=P, bad_to_good=R, state="link", step_s=STEP_NS * 1e-9, **settings
    )
    return Link(LinkSettings(impairments=(LossOf(loss=chain),), first_delivered=False), 7, "x")


def lost(one: Link, flow: int, now_ns: int) -> bool:
    one.handle(Datagram(flow, bytes(64)), now_ns)
    return one.decision.fate == Fate.DROPPED


def test_a_bad_state_concerns_all_flows_at_once() -> None:
    one = link()
    states = [
        {lost(one, flow, step * STEP_NS + flow * (STEP_NS // 50)) for flow in range(50)}
        for step in range(500)
    ]
    assert all(len(found) == 1 for found in states)
    assert 0 < sum(found == {True} for found in states) < 500


@pytest.mark.parametrize("every", [1, 7, 1000])
def test_the_states_at_a_distance_follow_the_powers_of_the_matrix(every: int) -> None:
    """Also if most steps are without a packet."""
    one, count = link(), 20_000
    bad = np.array([lost(one, i % 3, i * every * STEP_NS) for i in range(count)])
    moves = np.linalg.matrix_power(np.array([[1 - P, P], [R, 1 - R]]), every)
    for state in (0, 1):
        after = bad[1:][bad[:-1] == state]
        expected = moves[state, 1]
        spread = np.sqrt(expected * (1 - expected) / len(after))
        assert abs(after.mean() - expected) < 5 * spread


def test_losses_are_drawn_for_each_packet() -> None:
    """With half of the packets lost in either state, flows lose independently."""
    one = link(loss_in_bad=0.5, loss_in_good=0.5)
    found = np.array([[lost(one, flow, i * STEP_NS) for flow in (0, 1)] for i in range(4000)])
    assert abs(np.corrcoef(found.T)[0, 1]) < 5 / np.sqrt(4000)


def test_the_time_of_a_step_and_the_common_state_go_together() -> None:
    with pytest.raises(ValueError, match='state = "link" needs it'):
        GilbertElliottLoss(mean_loss=0.1, mean_burst=2.0, state="link")
    with pytest.raises(ValueError, match='state = "link" only'):
        GilbertElliottLoss(mean_loss=0.1, mean_burst=2.0, step_s=0.1)
