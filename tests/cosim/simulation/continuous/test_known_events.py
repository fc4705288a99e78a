"""Policies in continuous time: known events, and published bounds.

Each event of every policy is checked by an integrator in ../batch/test_exact_events.py.
"""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import quad
from scipy.linalg import expm

from cosim.simulation.continuous import (
    ContinuousLoop,
    ContinuousRun,
    TooManyEventsError,
    simulate_continuous,
)
from noack.scenario.resolution import LoopMatrices
from noack.trigger.trigger_rule import Forecast, TriggerRule
from tests.trigger_rules import (
    lyapunov_rule,
    mixed_rule,
    quadratic_rule,
    self_triggered_rule,
)

Vector = NDArray[np.float64]
A_MODEL = np.array([[0.0, 1.0], [-2.0, 3.0]])
B = np.array([[0.0], [1.0]])
K = np.array([[1.0, -4.0]])
CLOSED = A_MODEL + B @ K
P = np.array([[1.0, 0.25], [0.25, 1.0]])  # of V in Tabuada (2007), Section V
Q = -(CLOSED.T @ P + P @ CLOSED)
FORM = np.diag([-0.02, -0.02, 1.0, 1.0])
MS = 1_000_000


def loop_of(*, zoh: bool, mismatch: float = 0.1) -> LoopMatrices:
    return LoopMatrices(
        A_MODEL, B, K, np.zeros((2, 2)) if zoh else CLOSED,
        A_MODEL + mismatch * np.array([[0.1, -0.3], [0.5, 0.2]]), B, np.array([10.0, 0.0]), None,
        ("x_1", "x_2"), ("u",),
    )  # fmt: skip


def norm(v: Vector) -> float:
    return float(np.linalg.norm(v))


def run_of(policy: TriggerRule, *, zoh: bool, lost: int, horizon_s: float = 6.0) -> ContinuousRun:
    loop = loop_of(zoh=zoh)
    return simulate_continuous(
        ContinuousLoop(loop, policy), horizon_s=horizon_s, known_start=True,
        delivered=lambda event: event % (lost + 1) == lost, max_events=5000,
    )  # fmt: skip


@pytest.mark.parametrize("sigma", [0.02, 0.2])
def test_tabuadas_example_keeps_the_published_bound_and_comes_close_to_it(sigma: float) -> None:
    """IEEE TAC 52(9), 2007, Corollary IV.1 and Section V: |e| ≤ σ|x|, every update arrives.

    The inter-event time is at least τ with φ(τ) = σ, φ̇ = a + (a + b)φ + bφ², φ(0) = 0, a = |A+BK|,
    b = |BK|, for all initial states.
    """
    a, b = float(np.linalg.norm(CLOSED, 2)), float(np.linalg.norm(B @ K, 2))
    tau_s, _ = quad(lambda phi: 1 / (a + (a + b) * phi + b * phi**2), 0.0, sigma)
    system = ContinuousLoop(loop_of(zoh=True, mismatch=0.0), mixed_rule(sigma))
    shortest_s = math.inf
    for angle in np.linspace(0, math.pi, 40, endpoint=False):
        run = simulate_continuous(
            system, horizon_s=2.0, delivered=[], known_start=True,
            x0=10 * np.array([math.cos(angle), math.sin(angle)]),
        )  # fmt: skip
        shortest_s = min(shortest_s, float(np.diff(run.event_s).min()))
    assert shortest_s >= tau_s
    assert shortest_s < 1.2 * tau_s


def test_periodic_event_triggering_agrees_with_the_sampled_rule() -> None:
    """By powers of matrices, sample by sample."""
    run = run_of(quadratic_rule(FORM, 50 * MS, heartbeat=7), zoh=True, lost=1)
    transition = expm(run.system.generator * 0.05)
    z, since, expected, number = np.concatenate(run.start[1:]), 0, [], 0
    for k in range(1, 121):
        z, since = transition @ z, since + 1
        if z[:4] @ FORM @ z[:4] > 1e-12 or since == 7:
            expected.append(k * 0.05)
            z[2:4] = 0.0
            if number % 2 == 1:
                z[4:] = 0.0
            number, since = number + 1, 0
    assert len(expected) > 10
    np.testing.assert_allclose(run.event_s, expected, rtol=1e-9)


def test_a_self_trigger_stays_below_the_threshold_under_its_assumption() -> None:
    """ZOH, no losses: |ė| = |ẋ| ≤ |A| |e| + |A+BK| |x_k|, as x = x_k − e."""
    loop = loop_of(zoh=True, mismatch=0.0)
    L, a = np.linalg.norm(loop.A, 2), np.linalg.norm(CLOSED, 2)
    policy = self_triggered_rule(Forecast(0.5, 0.2, 0.0, float(L), float(a), 0.0), 1000, 10**9)
    system = ContinuousLoop(loop, policy)
    run = simulate_continuous(system, horizon_s=6.0, delivered=[], known_start=True)
    assert len(run.before) > 20
    for event in run.before:
        assert norm(event.e_s) <= 0.5 * math.exp(-0.2 * event.t_s) * (1 + 1e-9)


def test_events_accumulate_under_a_pure_envelope_when_updates_are_lost() -> None:
    rule = lyapunov_rule(np.linalg.cholesky(P).T, 0.2)
    with pytest.raises(TooManyEventsError):
        run_of(rule, zoh=True, lost=2)
