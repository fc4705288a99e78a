"""Trigger rules in arrays: what a :class:`noack.trigger.trigger_policy.Trigger` decides, compiled.

A forecast is not part of a row: who uses one sets ``latest_ns`` after each event.
"""

import math
from typing import Any

import numpy as np

from noack.core.ordered_arithmetic import multiply, norm_of
from noack.trigger.trigger_rule import TriggerRule

_NEVER_NS = 2**62
_RULE = ("level", "rate_per_s", "floor")
_FORMS = ("up", "down", "gain_up", "gain_down")
_WHOLE = (
    "from_event", "integrates", "is_dynamic", "grid_ns", "idle_ns", "longest_ns", "weight",
    *_FORMS, *(f"{name}_rows" for name in _FORMS),
)  # fmt: skip
_CONDITION = ("since_ns", "earliest_ns", "latest_ns")

TRIGGER = np.dtype(
    [(name, "<f8") for name in (*_RULE, "decay_per_s", "condition_level")]
    + [(name, "<i8") for name in (*_WHOLE, *_CONDITION)]
)
"""A loop's trigger: first its rule, then the condition since its last event.

``up``, ``down``, ``gain_up`` and ``gain_down`` are the places at which P, N, P_η and N_η begin in
an array of matrices, ``weight`` that of W; it is −1 for the identity.
"""


def has_array_form(rule: TriggerRule) -> bool:
    """Whether a fleet can apply a rule: without an auxiliary variable and without a forecast."""
    return rule.forecast is None and rule.dynamic_variable is None and not rule.integrates


def set_rule(trigger: Any, rule: TriggerRule, weight: Any, matrices: list[float]) -> None:
    """Set a row of type :data:`TRIGGER` to a rule; its matrices are appended to ``matrices``."""
    for name in _RULE:
        trigger[name] = getattr(rule, name)
    trigger["from_event"], trigger["integrates"] = rule.from_event, rule.integrates
    for name in ("grid_ns", "idle_ns", "longest_ns"):
        trigger[name] = int(min(max(getattr(rule, name), -_NEVER_NS), _NEVER_NS))
    forms = [*rule.form]
    if rule.dynamic_variable is not None:
        trigger["is_dynamic"], trigger["decay_per_s"] = True, rule.dynamic_variable.decay_per_s
        forms += rule.dynamic_variable.gain
    for name, matrix in zip(_FORMS, forms, strict=False):
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
        trigger.condition_level = image_norm(matrices, trigger.up, rows, n, z, scratch)
        trigger.since_ns = t_ns
    trigger.earliest_ns = t_ns + trigger.idle_ns
    trigger.latest_ns = t_ns + trigger.longest_ns


def is_event(
    trigger: Any, matrices: Any, t_ns: int, n: int, z: Any, auxiliary: float, sides: Any,
    scratch: Any,
) -> bool:  # fmt: skip
    """Return whether a measurement is an event; see :meth:`TriggerCondition.sides`.

    ``z`` is (x, e_s). ``sides``, (2,), gets both sides of the comparison.
    """
    right = trigger.condition_level
    if trigger.rate_per_s != 0.0:
        elapsed = float(t_ns - trigger.since_ns)
        right *= math.exp(-trigger.rate_per_s * elapsed * 1e-9)
    if trigger.floor > right:
        right = trigger.floor
    left = auxiliary
    if trigger.integrates == 0:
        rows = trigger.down_rows
        if rows > 0 or auxiliary > 0.0:
            scratch[1] = image_norm(matrices, trigger.down, rows, n, z, scratch)
            scratch[0] = right
            scratch[2] = math.sqrt(max(auxiliary, 0.0))
            right = norm_of(scratch, 0, 3)
        left = image_norm(matrices, trigger.up, trigger.up_rows, n, z, scratch)
    sides[0] = left
    sides[1] = right
    if t_ns >= trigger.latest_ns:
        return True
    counts = t_ns >= trigger.earliest_ns
    if trigger.grid_ns != 0:
        counts = counts and t_ns % trigger.grid_ns == 0
    return bool(counts and left > right)


def auxiliary_rate(trigger: Any, matrices: Any, n: int, z: Any, scratch: Any) -> float:
    """Return the rate of η, or of the integral, at z."""
    if trigger.integrates != 0:
        return image_norm(matrices, trigger.up, trigger.up_rows, n, z, scratch)
    if trigger.is_dynamic == 0:
        return 0.0
    up = image_norm(matrices, trigger.gain_up, trigger.gain_up_rows, n, z, scratch)
    down = image_norm(matrices, trigger.gain_down, trigger.gain_down_rows, n, z, scratch)
    return up * up - down * down


def auxiliary_after(trigger: Any, dt_s: float, value: float, first: float, last: float) -> float:
    """Return η, or the integral, after a time, from its rates at the first and the last time."""
    if trigger.integrates != 0:
        return value + dt_s * (first + last) / 2
    if trigger.is_dynamic == 0:
        return value
    decay = trigger.decay_per_s
    gained_s = -math.expm1(-decay * dt_s) / decay if decay > 0.0 else dt_s
    return value * math.exp(-decay * dt_s) + gained_s * first


def image_norm(matrices: Any, begin: int, rows: int, n: int, z: Any, scratch: Any) -> float:
    """Return ‖P z‖ of a matrix, (rows, 2n); ``scratch`` is overwritten."""
    multiply(matrices, begin, z, 0, scratch, 0, (rows, 2 * n))
    return norm_of(scratch, 0, rows)


def weighted_norm(
    trigger: Any, matrices: Any, vector: Any, begin: int, n: int, scratch: Any
) -> float:
    """Return ‖W v‖ of the n entries from ``begin`` on."""
    if trigger.weight < 0:
        return norm_of(vector, begin, n)
    multiply(matrices, trigger.weight, vector, begin, scratch, 0, (n, n))
    return norm_of(scratch, 0, n)
