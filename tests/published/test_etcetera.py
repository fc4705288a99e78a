"""ETCetera (github.com/sync-lab/ETCetera): the batch reactor of its documentation, scenario
``reactor_petc``, under periodic event-triggered control with a period of 10 ms.

Published are the times between two events in periods, those that may follow one of 1 period (a set
that may be too large), and the region of the states that wait 2 periods.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from cosim.simulation.continuous import ContinuousLoop
from noack.core.linear_systems import Matrix
from tests.published.exact_runs import run_from_each, shipped_loop

PERIOD_S = 0.01
INTERVALS, AFTER_ONE = {1, 2, 3, 4, 5}, {1, 2, 3}
WAITS_ONE = [
    [0.0325014371942073, -0.758236561497541, 2.28413716988318, -1.57991935089754],
    [-0.758236561497541, 2.38486724990143, 0.198562111037632, 2.68392804714407],
    [2.28413716988318, 0.198562111037632, 3.0913841666531, -2.03625414224163],
    [-1.57991935089754, 2.68392804714407, -2.03625414224163, 2.14744812716726],
]
WAITS_TWO = [
    [34.1084257021831, -22.2685952023407, 68.7949413314049, -47.7543148417454],
    [-22.2685952023407, 102.519813292189, 8.36602721281553, 82.3989681651887],
    [68.7949413314049, 8.36602721281553, 121.315797670082, -56.7655786995279],
    [-47.7543148417454, 82.3989681651887, -56.7655786995279, 97.0796601856019],
]
"""The states that transmit after two periods: xᵀMx ≤ 0 of the first matrix, > 0 of the second."""


def periods_from(loop: ContinuousLoop, states: Matrix) -> NDArray[np.int64]:
    """Return the periods until the first event from each state."""
    log = run_from_each(loop, states, 0.2, 30)
    return np.asarray(np.rint(log.event_s[:, 0] / PERIOD_S), np.int64)


def held_map(loop: ContinuousLoop, periods: int) -> Matrix:
    """Return M of x(t) = M x(0), at the time t that is ``periods`` after an event."""
    A, BK = loop.loop.A, loop.loop.B @ loop.loop.K
    transition = expm(np.block([[A, BK], [np.zeros((4, 8))]]) * PERIOD_S * periods)
    return np.asarray(transition[:4, :4] + transition[:4, 4:])


def slowest_state(loop: ContinuousLoop, periods: int) -> tuple[float, Matrix]:
    """Return the smallest eigenvalue of the trigger's form after ``periods``, and its state.

    If it is positive, every state has transmitted by then.
    """
    P, N = loop.trigger.form
    z = np.vstack([M := held_map(loop, periods), np.eye(4) - M])
    values, vectors = np.linalg.eigh(z.T @ (P.T @ P - N.T @ N) @ z)
    return float(values[0]), vectors[:, 0]


def test_times_between_events_are_the_published_ones() -> None:
    loop = shipped_loop("reactor_petc")
    drawn = np.random.default_rng(1).normal(size=(2000, 4))
    states = np.vstack([drawn, *(slowest_state(loop, k)[1] for k in range(1, 5))])
    periods = periods_from(loop, states)
    assert set(periods.tolist()) == INTERVALS
    assert slowest_state(loop, 5)[0] > 0
    assert set(periods_from(loop, states[periods == 1] @ held_map(loop, 1).T).tolist()) <= AFTER_ONE
    stays, leaves = (np.einsum("ki,ij,kj->k", states, M, states) for M in (WAITS_ONE, WAITS_TWO))
    np.testing.assert_array_equal((stays <= 0) & (leaves > 0), periods == 2)
    assert (periods == 2).sum() > 300
