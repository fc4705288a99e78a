"""Trigger rules of n states by numbers, which tests need without a model."""

import json

import numpy as np

from netem.core.settings_section import Table
from noack.core.linear_systems import Matrix
from noack.scenario.sections import POLICIES
from noack.trigger_policies.mixed import mixed_rule as given_mixed_rule
from noack.trigger_policies.policy_settings import ModelMatrices
from noack.trigger_policies.trigger_rule import TriggerRule, error_form, quadratic_form, require_rule

EXAMPLES: dict[str, Table] = {
    name: example.model_dump(mode="json", exclude_none=True)
    for name, made in POLICIES.items()
    if (example := made.example(2)) is not None
}
"""The table of each policy that is a rule, for two states."""


DECAYING = {"policy": "decaying", "beta": 0.2, "alpha_per_s": 0.5, "floor": (0.0, 0.1, 1.0)}
MIXED = {"policy": "mixed", "sigma": 0.05, "epsilon": (0.003, 0.02, 0.05)}
AREA = {"policy": "send_on_area", "delta_s": 0.01}
LYAPUNOV = {"policy": "lyapunov", "rate_per_s": 1.2}
DYNAMIC = {
    "policy": "dynamic", "sigma": 0.1, "theta_s": (0.01, 0.5), "decay_per_s": (0.0, 1.0, 30.0),
    "eta_0": (0.0, 0.05),
}  # fmt: skip
QUADRATIC = {
    "policy": "quadratic", "period_s": (0.1, 0.007, 0.033), "epsilon": (0.0, 1e-4),
    "heartbeat": (0, 6),
}  # fmt: skip
SELF_TRIGGERED = {
    "policy": "self_triggered", "beta": 0.3, "alpha_per_s": 0.5, "floor": 0.01,
    "growth_per_s": (0.0, 2.0), "mismatch_per_s": 1.0, "disturbance_per_s": 0.1,
    "shortest_s": 0.01, "longest_s": 1.0,
}  # fmt: skip


def dwell(rule: Table, interval_s: float) -> Table:
    """A rule that is not tested for a time after an event."""
    return {"policy": "dwell", "interval_s": interval_s, "rule": rule}


def deadline(rule: Table, interval_s: float) -> Table:
    """A rule with an event at the latest after a time."""
    return {"policy": "deadline", "interval_s": interval_s, "rule": rule}


TABLES: dict[str, Table] = {
    "decaying": DECAYING,
    "absolute": {"policy": "absolute", "delta": 0.01},
    "relative": {"policy": "relative", "sigma": (0.01, 0.03, 0.05)},
    "mixed": MIXED,
    "send_on_area": AREA,
    "dwell of send_on_area": dwell(AREA, 0.12),
    "lyapunov": LYAPUNOV,
    "dynamic": DYNAMIC,
    "quadratic": QUADRATIC,
    "periodic": {"policy": "periodic", "period_s": 0.1},
    "self_triggered": SELF_TRIGGERED,
    "deadline of decaying": deadline(DECAYING, 0.3),
    "deadline of mixed": deadline(MIXED, 0.3),
    "dwell of decaying": dwell(DECAYING, 0.1),
    "dwell of lyapunov": dwell(LYAPUNOV, 0.1),
    "dwell of dynamic": dwell(DYNAMIC, 0.1),
    "dwell of quadratic": dwell(QUADRATIC, 0.015000003),
    "dwell of deadline of self_triggered": dwell(deadline(SELF_TRIGGERED, 0.2), 0.05),
    "deadline within a dwell": deadline(dwell(DYNAMIC, 0.3), 0.1),
}
"""Tables of all policies that are rules, and of combinations; one of several values is drawn."""


def drawn(table: Table, rng: np.random.Generator, n: int = 2, weight: Matrix | None = None) -> Table:
    """A table for n states; "quadratic" gets a random matrix."""
    values = {
        key: rng.choice(value).item() if isinstance(value, tuple) else value for key, value in table.items()
    }
    if "rule" in values:
        return values | {"rule": drawn(values["rule"], rng, n, weight)}
    if values["policy"] == "quadratic":
        apart = 0.05 * rng.uniform(-1, 1, (2 * n, 2 * n))
        values["Q"] = (np.diag([-0.02] * n + [1.0] * n) + apart + apart.T).tolist()
    return values if weight is None else values | {"weight": weight.tolist()}


def rule_from(table: Table, model: ModelMatrices) -> TriggerRule:
    """The rule of a scenario's table."""
    settings = POLICIES[table["policy"]].model_validate_json(json.dumps(table))
    return require_rule(settings.trigger_policy(model))


def random_rule(name: str, rng: np.random.Generator, n: int, weight: Matrix | None = None) -> TriggerRule:
    """A rule of a table, with the matrices of a random model of n states."""
    BK = 3 * rng.uniform(-1, 1, (n, n))
    closed = 0.3 * rng.uniform(-1, 1, (n, n)) - np.eye(n)
    table = drawn(TABLES[name], rng, n, weight)
    return rule_from(table, ModelMatrices(closed - BK, BK, np.eye(n)))


def decaying_rule(
    beta: float, alpha_per_s: float, floor: float = 0.0, weight: Matrix | None = None, n: int = 2
) -> TriggerRule:
    """‖e_s‖_W exceeds max(βe^(−αt), floor), the paper's rule."""
    n = n if weight is None else len(weight)
    return TriggerRule(error_form(n, weight), beta, alpha_per_s, floor, weight=weight)


def absolute_rule(delta: float, weight: Matrix | None = None, n: int = 2) -> TriggerRule:
    """‖e_s‖_W exceeds δ."""
    n = n if weight is None else len(weight)
    return TriggerRule(error_form(n, weight), floor=delta, weight=weight)


def area_rule(delta_s: float, weight: Matrix | None = None, n: int = 2) -> TriggerRule:
    """The integral of ‖e_s‖_W since the last event exceeds δ."""
    return absolute_rule(delta_s, weight, n)._replace(integrates=True)


def mixed_rule(sigma: float, epsilon: float = 0.0, weight: Matrix | None = None, n: int = 2) -> TriggerRule:
    """‖e_s‖_W² exceeds σ²‖x‖_W² + ε²."""
    return given_mixed_rule(n if weight is None else len(weight), sigma, epsilon, weight)


def quadratic_rule(
    Q: Matrix, period_ns: int, epsilon: float = 0.0, heartbeat: int = 0,
    weight: Matrix | None = None,
) -> TriggerRule:  # fmt: skip
    """A quadratic form of (x, e_s) exceeds ε; tested once a period, with an event every ``heartbeat``."""
    longest_ns = heartbeat * period_ns if heartbeat else np.inf
    return TriggerRule(
        quadratic_form(Q), floor=float(np.sqrt(epsilon)), grid_ns=period_ns, longest_ns=longest_ns,
        weight=weight,
    )  # fmt: skip
