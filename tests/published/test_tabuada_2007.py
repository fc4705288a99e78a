"""Tabuada, Event-Triggered Real-Time Scheduling of Stabilizing Control Tasks, IEEE TAC 52(9), 2007.

Corollary IV.1 bounds the times between two events of the trigger ‖e‖ > σ‖x‖ from below.
"""

import numpy as np
import pytest
from scipy.integrate import quad

from cosim.simulation.continuous import ContinuousLoop
from tests.published.exact_runs import run_from_each, shipped_loop, states_on_a_circle


def bound_s(loop: ContinuousLoop, sigma: float) -> float:
    """Return τ: φ(τ) = σ, φ̇ = a + (a+b)φ + bφ², φ(0) = 0, a = ‖A+BK‖, b = ‖BK‖."""
    BK = loop.loop.B @ loop.loop.K
    a, b = np.linalg.norm(loop.loop.A + BK, 2), np.linalg.norm(BK, 2)
    bound, _ = quad(lambda phi: 1 / (a + (a + b) * phi + b * phi**2), 0.0, sigma)
    return float(bound)


@pytest.mark.parametrize("sigma", [0.02, 0.05, 0.1, 0.2])
def test_no_time_between_events_is_below_the_bound_and_some_are_close(sigma: float) -> None:
    loop = shipped_loop("tabuada_dynamic", f'trigger={{policy="relative", sigma={sigma}}}')
    log = run_from_each(loop, 10 * states_on_a_circle(40), 2.0, 2000)
    shortest_s = float(np.nanmin(np.diff(log.event_s, prepend=0.0)))
    assert bound_s(loop, sigma) <= shortest_s <= 1.2 * bound_s(loop, sigma)
