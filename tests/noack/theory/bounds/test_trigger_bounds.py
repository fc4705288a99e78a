"""The bound of e_s that a rule sets."""

import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from noack.theory.bounds.trigger_bounds import comparison_bound
from tests.helpers.example_rules import quadratic_rule

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
