"""The bound of e_s that a rule sets, against the boundary of the rule itself."""

from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from noack.scenario.scenario_file import validate
from noack.theory.bounds.trigger_bounds import comparison_bound
from noack.trigger.dynamic import DynamicSettings
from noack.trigger.lyapunov import LyapunovSettings
from noack.trigger.policy_settings import LyapunovFunctionSettings, ModelMatrices
from tests.trigger_rules import quadratic_rule

EPSILON = 0.3
SCENARIO: dict[str, Any] = {
    "name": "test", "horizon_s": 1.0,
    "model": {"A": [[0.0]], "B": [[1.0]], "gain": [[-1.0]]},
    "plant": {"initial_state": [1.0]},
    "network": {"mansd": 1, "loss": {"model": "lossless"}},
}  # fmt: skip


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


@pytest.mark.parametrize("kind", [LyapunovSettings, DynamicSettings])
def test_rules_that_leave_e_s_unbounded_set_no_bound(
    kind: type[LyapunovFunctionSettings],
) -> None:
    model = ModelMatrices(np.zeros((2, 2)), np.eye(2), -np.eye(2))
    settings = kind.example(2)
    assert settings is not None
    rule = settings.trigger_policy(model)
    assert comparison_bound(rule, np.eye(2)) is None


def test_the_same_threshold_from_a_later_origin() -> None:
    rule = {"beta": 0.5, "alpha_per_s": 0.25}
    trigger = {"policy": "deadline", "rule": rule, "interval_s": 1.0}
    late = validate(SCENARIO | {"trigger": trigger}, "test").trigger.at_origin(3.0)
    model = ModelMatrices(np.zeros((1, 1)), np.eye(1), -np.eye(1))
    found = late.trigger_policy(model)
    assert found.level == pytest.approx(0.5 * np.exp(-0.75), rel=1e-12)
    assert found.longest_ns == 10**9
