"""Compare with the chain's stationary distribution and matrix powers, by linear algebra."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from noack.impairments.kinds.loss import LossOf
from noack.impairments.loss_models.four_state import FourStateLoss

LOSES = np.array([False, False, True, True])


def matrix(chain: FourStateLoss) -> Any:
    """Return the transition matrix; row i contains the transitions from state i + 1."""
    c = chain
    return np.array(
        [
            [1 - c.p13 - c.p14, 0, c.p13, c.p14],
            [0, 1 - c.p23, c.p23, 0],
            [c.p31, c.p32, 1 - c.p31 - c.p32, 0],
            [1, 0, 0, 0],
        ]
    )


CHAINS = [
    FourStateLoss(p13=0.05, p31=0.2),
    FourStateLoss(p13=0.02, p31=0.1, p32=0.3, p23=0.4, p14=0.03),
    FourStateLoss(p13=0.1, p31=0.5, p32=0.5, p23=0.9, p14=0.9),
]


@pytest.mark.parametrize("chain", CHAINS, ids=("two states", "all", "full rows"))
def test_losses_follow_the_chain(
    decide: Any, share_is: Callable[..., None], chain: FourStateLoss
) -> None:
    lost = decide([LossOf(loss=chain)], 1_000_000).fates == 1
    P = matrix(chain)
    values, vectors = np.linalg.eig(P.T)
    stationary = np.real(vectors[:, np.argmax(np.real(values))])
    stationary /= stationary.sum()
    share_is(lost, float(stationary @ LOSES))
    for lag in (1, 2, 3, 5):
        together = stationary * LOSES @ np.linalg.matrix_power(P, lag) @ LOSES
        share_is(lost[lag:] & lost[:-lag], float(together))


def test_the_chain_begins_in_the_gap_state_and_moves_before_each_datagram(decide: Any) -> None:
    """The distribution of the k-th packet's state is e₁ Pᵏ⁺¹ (average over many flows)."""
    chain, flows, steps = CHAINS[1], 20_000, 4
    order = np.tile(np.arange(flows), steps)
    fates = decide([LossOf(loss=chain)], len(order), flows=order).fates.reshape(steps, flows)
    state = np.array([1.0, 0, 0, 0])
    for of_step in fates == 1:
        state = state @ matrix(chain)
        p = float(state @ LOSES)
        assert abs(of_step.mean() - p) <= 5 * np.sqrt(p * (1 - p) / flows)
