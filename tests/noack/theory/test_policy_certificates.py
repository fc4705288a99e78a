"""Certificates of every trigger policy under disturbances, and the bound of e_s that a rule sets.

``certificate_kinds/policies.py`` has the loops without disturbances, and the broken copies.
"""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from noack.theory.bounds.trigger_bounds import comparison_bound
from noack.theory.certificates.scenario_certificates import certify
from tests.noack.theory.certificate_kinds.policies import POLICY_KINDS, exceeded_by, policy_case
from tests.noack.theory.disturbed_loops import DisturbedLoop, signals
from tests.oracles.lossy_loops import SEARCH, STEPS, System, networks, seeds, simulate, systems
from tests.trigger_rules import quadratic_rule


@pytest.mark.parametrize("kind", POLICY_KINDS)
@settings(SEARCH, max_examples=3)
@given(systems(step_share=0.002), st.sampled_from([0.02, 0.3]), seeds)
def test_no_bound_of_a_policy_is_exceeded_under_disturbances(
    kind: str, system: System, push: float, seed: int
) -> None:
    resolved, rule, system = policy_case(kind, system, seed, push)
    certificate, n = certify(resolved, system.conditions), len(system.A)
    if certificate.constants is not None:
        loop = DisturbedLoop(system, push * np.eye(n), (STEPS,) * n, np.zeros(n), 0.0)
        pushes, _ = signals(loop, np.random.default_rng(seed))
        trace = simulate(system, *networks(seed, system), rule=rule, pushes=pushes)
        assert exceeded_by(trace, certificate, system) == []


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
