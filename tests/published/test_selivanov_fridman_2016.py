"""Selivanov, Fridman, Event-Triggered H-infinity Control: a Switching Approach, IEEE TAC 61(10), 2016.

Example 1: Theorem 1 (the sensor waits for h, then tests at all times) and Remark 1 (it tests at
multiples of h) guarantee that V(t_k) e^(2δt_k) ≤ V(0) at each transmission, with V = xᵀPx. P is that
of a solution of their matrix inequalities. The abstract says that the switching trigger sends less.
"""

import numpy as np
import pytest

from cosim.simulation.continuous import ContinuousLoop
from noack.core.linear_systems import Matrix
from tests.published.exact_runs import run_from_each, shipped_loop, states_on_a_circle

DELTA = 0.24
PERIOD_S, EPSILON = 1.115, 0.0046
"""h and ε of Remark 1; those of Theorem 1 are in the scenario."""
P_SWITCHING = np.array([[1, 0.318841], [0.318841, 0.415189]])
P_PERIODIC = np.array([[1, 0.104472], [0.104472, 0.334231]])


def switching() -> ContinuousLoop:
    """After the waiting time the trigger is tested at all times."""
    loop = shipped_loop("selivanov_switching")
    return ContinuousLoop(loop.loop, loop.trigger._replace(grid_ns=0.0))


def periodic() -> ContinuousLoop:
    Q = f"[[{-EPSILON}, 0, 0, 0], [0, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 0]]"
    trigger = f'trigger={{policy="quadratic", period_s={PERIOD_S}, Q={Q}}}'
    return shipped_loop("selivanov_switching", trigger, "plant.rate_hz=200")


def growth_and_transmissions(loop: ContinuousLoop, P: Matrix) -> tuple[float, float]:
    """Return the largest V(t_k) e^(2δt_k) / V(0) of all runs, and the mean number of transmissions."""
    x0 = states_on_a_circle(100)
    log = run_from_each(loop, x0, 20.0, 100)
    assert log.states is not None
    has_event = ~np.isnan(log.event_s)
    x, t_s = log.states[:, :, 0][has_event], log.event_s[has_event]
    starts = np.repeat(x0, has_event.sum(axis=1), axis=0)
    energies, at_start = (np.einsum("ki,ij,kj->k", states, P, states) for states in (x, starts))
    growth = energies * np.exp(2 * DELTA * t_s) / at_start
    return float(growth.max()), 1 + len(t_s) / len(x0)


def test_both_triggers_decay_as_guaranteed_and_the_switching_one_sends_less() -> None:
    growth, sent = growth_and_transmissions(switching(), P_SWITCHING)
    growth_periodic, sent_periodic = growth_and_transmissions(periodic(), P_PERIODIC)
    assert max(growth, growth_periodic) <= 1
    assert sent < sent_periodic
    assert sent / sent_periodic == pytest.approx(0.652, abs=5e-4)
