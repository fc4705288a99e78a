"""Trigger rules of n states by numbers, which tests need without a model."""

from typing import Any

import numpy as np

from noack.config.sections import POLICIES
from noack.core.linear_systems import Matrix
from noack.trigger.deadline import with_deadline as with_deadline
from noack.trigger.dwell import with_dwell_time as with_dwell_time
from noack.trigger.dynamic import DynamicSettings
from noack.trigger.dynamic import dynamic_rule as given_dynamic_rule
from noack.trigger.lyapunov import lyapunov_rule as given_lyapunov_rule
from noack.trigger.mixed import mixed_rule as given_mixed_rule
from noack.trigger.trigger_rule import (
    NEVER_NS,
    Forecast,
    TriggerRule,
    error_form,
    no_form,
    quadratic_form,
)

EXAMPLES: dict[str, dict[str, Any]] = {
    name: example.model_dump(mode="json", exclude_none=True)
    for name, made in POLICIES.items()
    if (example := made.example(2)) is not None
}
"""The table of each policy that is a rule, for two states."""


def decaying_rule(
    beta: float, alpha_per_s: float, floor: float = 0.0, weight: Matrix | None = None, n: int = 2
) -> TriggerRule:
    n = n if weight is None else len(weight)
    return TriggerRule(error_form(n, weight), beta, alpha_per_s, floor, weight=weight)


def absolute_rule(delta: float, weight: Matrix | None = None, n: int = 2) -> TriggerRule:
    n = n if weight is None else len(weight)
    return TriggerRule(error_form(n, weight), floor=delta, weight=weight)


def area_rule(delta_s: float, weight: Matrix | None = None, n: int = 2) -> TriggerRule:
    return absolute_rule(delta_s, weight, n)._replace(integrates=True)


def mixed_rule(
    sigma: float, epsilon: float = 0.0, weight: Matrix | None = None, n: int = 2
) -> TriggerRule:
    return given_mixed_rule(n if weight is None else len(weight), sigma, epsilon, weight)


def dynamic_rule(
    sigma: float, theta_s: float, decay_per_s: float, P: Matrix, Q: Matrix, BK: Matrix,
    eta_0: float = 0.0, weight: Matrix | None = None,
) -> TriggerRule:  # fmt: skip
    settings = DynamicSettings(
        policy="dynamic", sigma=sigma, theta_s=theta_s, decay_per_s=decay_per_s, eta_0=eta_0
    )
    return given_dynamic_rule(settings, P, Q, BK)._replace(weight=weight)


def quadratic_rule(
    Q: Matrix, period_ns: int, epsilon: float = 0.0, heartbeat: int = 0,
    weight: Matrix | None = None,
) -> TriggerRule:  # fmt: skip
    longest_ns = heartbeat * period_ns if heartbeat else NEVER_NS
    return TriggerRule(
        quadratic_form(Q), floor=float(np.sqrt(epsilon)), grid_ns=period_ns, longest_ns=longest_ns,
        weight=weight,
    )  # fmt: skip


def periodic_rule(period_ns: int, weight: Matrix | None = None, n: int = 2) -> TriggerRule:
    n = n if weight is None else len(weight)
    return TriggerRule(no_form(n), longest_ns=period_ns, weight=weight)


def self_triggered_rule(
    forecast: Forecast, shortest_ns: int, longest_ns: int, weight: Matrix | None = None, n: int = 2
) -> TriggerRule:
    rule = periodic_rule(longest_ns, weight, n)
    return rule._replace(shortest_ns=shortest_ns, forecast=forecast)


def lyapunov_rule(factor: Matrix, rate_per_s: float, weight: Matrix | None = None) -> TriggerRule:
    return given_lyapunov_rule(factor, rate_per_s, weight)
