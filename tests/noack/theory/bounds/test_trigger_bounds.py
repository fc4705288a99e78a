"""The bound of e_s that a rule sets, and the first passage of a threshold."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from noack.theory.bounds.certificate_terms import NetworkConditions
from noack.theory.bounds.gains import PlantGains
from noack.theory.bounds.trigger_bounds import comparison_bound, first_passage_s
from tests.helpers.example_rules import quadratic_rule
from tests.noack.theory.certificates.certified_loops import certify_loop, gains_of
from tests.oracles.lossy_loops import System

EPSILON = 0.3


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32), st.integers(1, 4))
def test_no_e_s_at_which_a_quadratic_rule_is_silent_exceeds_the_bound(seed: int, n: int) -> None:
    """zᵀQz = ε is solved along random directions of e_s, for random x."""
    rng = np.random.default_rng(seed)
    W = rng.uniform(-1, 1, (n, n)) + 1.5 * np.eye(n)
    Q = rng.uniform(-1, 1, (2 * n, 2 * n))
    Q = Q + Q.T
    Q[n:, n:] += 3 * np.eye(n)
    bounded = comparison_bound(quadratic_rule(Q, 10**7, EPSILON, 0, W), W)
    assume(bounded is not None)
    assert bounded is not None
    for _ in range(20):
        x, direction = rng.normal(size=n) * 10 ** rng.uniform(-2, 2), rng.normal(size=n)
        roots = np.roots([
            direction @ Q[n:, n:] @ direction, 2 * direction @ Q[n:, :n] @ x,
            x @ Q[:n, :n] @ x - EPSILON,
        ])  # fmt: skip
        bound = bounded.size * EPSILON**0.5
        bound += sum(float(np.linalg.norm(S @ x)) for S in bounded.shares)
        for root in roots[np.isreal(roots)].real:
            assert np.linalg.norm(W @ (root * direction)) <= bound


def passage_s(plant: PlantGains, *values: float) -> float:
    """The first passage of one loop from 0."""
    return float(first_passage_s(plant, *np.array([*values, 0.0])[:, None])[0])


def test_without_mismatch_or_push_the_threshold_is_never_reached() -> None:
    system = System(
        A=np.array([[-2.0]]), B=np.array([[1.0]]), K=np.array([[0.0]]), H=np.array([[-2.0]]),
        weight=np.eye(1), x0=np.ones(1), alpha=1.0, beta=0.1, known_start=True, mansd=0,
        step_s=0.01, sample_steps=1, delay_steps=0, hold_steps=0, lag_steps=0,
    )  # fmt: skip
    plant = gains_of(system)
    assert passage_s(plant, 0.1, 0.0, 0.0, 0.0) >= 1e6
    found = certify_loop(system, NetworkConditions(0))
    assert found.inter_event_s is not None
    assert found.inter_event_s >= 1e6
    # ρ = π'(1 − e^{−t}): never above π', and half of it at ln 2.
    assert passage_s(plant, 0.5, 0.0, 1.0, 0.0) == pytest.approx(math.log(2), rel=0.01)
    assert passage_s(plant, 0.5, 0.0, 1.0, 0.0) <= math.log(2)
    assert passage_s(plant, 1.01, 0.0, 1.0, 0.0) > 4
