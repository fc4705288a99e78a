"""Trigger rules of many loops in arrays: what a :class:`Trigger` decides, compiled.

Only rules without an auxiliary variable and without a forecast have this form.
"""

import math
from typing import Any

import numpy as np

from noack.core.ordered_arithmetic import multiply, norm_of
from noack.trigger.trigger_rule import TriggerRule

_NEVER_NS = 2**62
_RULE = ("level", "rate_per_s", "floor")
_WHOLE = (
    "from_event", "grid_ns", "idle_ns", "longest_ns", "up", "up_rows", "down", "down_rows",
    "weight",
)  # fmt: skip
_CONDITION = ("since_ns", "earliest_ns", "latest_ns")

TRIGGER = np.dtype(
    [(name, "<f8") for name in (*_RULE, "condition_level")]
    + [(name, "<i8") for name in (*_WHOLE, *_CONDITION)]
)
"""A loop's trigger: first its rule, then the condition since its last event.

``up``, ``down`` and ``weight`` are the places at which P, N and W begin in an array of matrices;
``weight`` is −1 for the identity.
"""


def has_array_form(rule: TriggerRule) -> bool:
    """Whether compiled code can apply a rule."""
    return rule.forecast is None and rule.dynamic_variable is None and not rule.integrates


def set_rule(trigger: Any, rule: TriggerRule, weight: Any, matrices: list[float]) -> None:
    """Set a row of type :data:`TRIGGER` to a rule; its matrices are appended to ``matrices``."""
    for name in _RULE:
        trigger[name] = getattr(rule, name)
    trigger["from_event"] = rule.from_event
    for name in ("grid_ns", "idle_ns", "longest_ns"):
        trigger[name] = int(min(max(getattr(rule, name), -_NEVER_NS), _NEVER_NS))
    for name, matrix in (("up", rule.form.up), ("down", rule.form.down)):
        trigger[name], trigger[f"{name}_rows"] = len(matrices), len(matrix)
        matrices += matrix.ravel().tolist()
    trigger["weight"] = -1 if weight is None else len(matrices)
    matrices += [] if weight is None else weight.ravel().tolist()


def start_condition(
    trigger: Any, matrices: Any, t_ns: int, x: Any, begin: int, n: int, z: Any, scratch: Any
) -> None:
    """Apply the rule after an event at a state; see :meth:`TriggerRule.after`.

    ``z``, (2n,), and ``scratch`` are overwritten.
    """
    trigger.condition_level = trigger.level
    trigger.since_ns = 0
    if trigger.from_event != 0:
        for k in range(n):
            z[k] = x[begin + k]
            z[n + k] = 0.0
        rows = trigger.up_rows
        multiply(matrices, trigger.up, z, 0, scratch, 0, (rows, 2 * n))
        trigger.condition_level = norm_of(scratch, 0, rows)
        trigger.since_ns = t_ns
    trigger.earliest_ns = t_ns + trigger.idle_ns
    trigger.latest_ns = t_ns + trigger.longest_ns


def is_event(
    trigger: Any, matrices: Any, t_ns: int, n: int, z: Any, sides: Any, scratch: Any
) -> bool:
    """Return whether a measurement is an event; see :meth:`TriggerCondition.sides`.

    ``z`` is (x, e_s). ``sides``, (2,), gets both sides of the comparison.
    """
    elapsed = float(t_ns - trigger.since_ns)
    right = trigger.condition_level * math.exp(-trigger.rate_per_s * elapsed * 1e-9)
    if trigger.floor > right:
        right = trigger.floor
    rows = trigger.down_rows
    if rows > 0:
        multiply(matrices, trigger.down, z, 0, scratch, 0, (rows, 2 * n))
        scratch[1] = norm_of(scratch, 0, rows)
        scratch[0] = right
        scratch[2] = 0.0
        right = norm_of(scratch, 0, 3)
    rows = trigger.up_rows
    multiply(matrices, trigger.up, z, 0, scratch, 0, (rows, 2 * n))
    left = norm_of(scratch, 0, rows)
    sides[0] = left
    sides[1] = right
    if t_ns >= trigger.latest_ns:
        return True
    counts = t_ns >= trigger.earliest_ns
    if trigger.grid_ns != 0:
        counts = counts and t_ns % trigger.grid_ns == 0
    return bool(counts and left > right)


def weighted_norm(trigger: Any, matrices: Any, n: int, z: Any, scratch: Any) -> float:
    """Return ‖W e_s‖ of z = (x, e_s)."""
    if trigger.weight < 0:
        return norm_of(z, n, n)
    multiply(matrices, trigger.weight, z, n, scratch, 0, (n, n))
    return norm_of(scratch, 0, n)
