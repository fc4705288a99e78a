"""A trigger rule as the core's structure ``noack_trigger_rule``; see native/loop/trigger.c."""

import math
from typing import Any

from noack.core.core_memory import CoreMemory
from noack.core.linear_systems import Matrix
from noack.trigger.trigger_rule import TriggerRule

_NEVER_NS = 2**60
"""The core's longest time; no run is as long."""


def fill_rule(
    structure: Any,
    rule: TriggerRule,
    weight: Matrix | None,
    initial_dynamic_variable: float,
    memory: CoreMemory,
) -> None:
    """Fill a ``noack_trigger_rule``; its matrices live in ``memory``.

    Args:
        structure: the structure.
        rule: the rule.
        weight: W of the norm that is recorded, (n, n); None is the identity.
        initial_dynamic_variable: η at the start.
        memory: keeps the matrices.
    """
    dynamic, forecast = rule.dynamic_variable, rule.forecast
    memory.fill(structure, {
        "level": rule.level, "rate_per_s": rule.rate_per_s, "floor": rule.floor,
        "from_event": rule.from_event, "integrates": rule.integrates,
        "is_dynamic": dynamic is not None, "initial": initial_dynamic_variable,
        "decay_per_s": 0.0 if dynamic is None else dynamic.decay_per_s,
        "grid_ns": _whole_ns(rule.grid_ns), "idle_ns": _whole_ns(rule.idle_ns),
        "shortest_ns": _whole_ns(rule.shortest_ns), "longest_ns": _whole_ns(rule.longest_ns),
        "forecasts": forecast is not None, "weight": weight, "forecast_weight": rule.weight,
    })  # fmt: skip
    if forecast is not None:
        memory.fill(structure, {
            "beta": forecast.beta, "alpha_per_s": forecast.alpha_per_s,
            "forecast_floor": forecast.floor, "growth_per_s": forecast.growth_per_s,
            "mismatch_per_s": forecast.mismatch_per_s,
            "disturbance_per_s": forecast.disturbance_per_s,
        })  # fmt: skip
    forms = {"": rule.form, "gain_": None if dynamic is None else dynamic.gain}
    for prefix, form in forms.items():
        for name in ("up", "down"):
            matrix = None if form is None else getattr(form, name)
            setattr(structure, f"{prefix}{name}_rows", 0 if matrix is None else len(matrix))
            if matrix is not None and len(matrix):
                setattr(structure, f"{prefix}{name}", memory.reals(matrix))


def rule_rows(rule: TriggerRule) -> int:
    """Return the rows of a rule's longest matrix; at least the number of states."""
    dynamic, n = rule.dynamic_variable, rule.form.up.shape[1] // 2
    matrices = [*rule.form, *(() if dynamic is None else dynamic.gain)]
    return max(n, *map(len, matrices))


def _whole_ns(t_ns: float) -> int:
    """Return the first whole number from ``t_ns`` on: times of measurements are whole."""
    return math.ceil(min(max(t_ns, -_NEVER_NS), _NEVER_NS))
