"""Policy settings that cannot be applied, and the key that the error names."""

import math
from typing import Any

import numpy as np
import pytest

from noack.config.scenario_file import validate
from noack.core.errors import CallerError
from noack.trigger.trigger_condition import QuadraticForm

DYNAMIC = {"policy": "dynamic", "sigma": 0.5, "theta_s": 0.5, "decay_per_s": 0.5}
RULE = {"policy": "quadratic", "Q": [[0.0] * 4] * 4, "period_s": 0.003}


def nested(rule: dict[str, Any]) -> dict[str, Any]:
    inner = {"policy": "dwell", "interval_s": 0.1, "rule": rule}
    return {"policy": "deadline", "interval_s": 1.0, "rule": inner}


@pytest.mark.parametrize(
    ("trigger", "expected"),
    [
        ({"policy": "absolute", "delta": 1e-300}, "trigger.delta = 1e-300: should be greater"),
        ({"policy": "relative", "sigma": 1e300}, "trigger.sigma = 1e+300: should be less"),
        ({"policy": "mixed", "sigma": 1.0, "epsilon": 1e200}, "trigger.epsilon = 1e+200: should"),
        ({"policy": "lyapunov", "rate_per_s": 1e300}, "trigger.rate_per_s = 1e+300: should be"),
        (DYNAMIC | {"decay_per_s": 1e6}, "trigger.decay_per_s = 1000000.0: should be less"),
        (RULE, "trigger.period_s = 0.003: must be a whole number of the 0.002 s"),
        (nested(RULE), "trigger.rule.rule.period_s = 0.003: must be a whole number"),
        (
            nested({"policy": "absolute", "delta": 1.0, "weight": [[1.0, 1.0], [1.0, 1.0]]}),
            "trigger.rule.rule.weight = [[1.0, 1.0], [1.0, 1.0]]: W must be invertible",
        ),
    ],
)
def test_a_mistake_names_its_key(
    content: dict[str, Any], trigger: dict[str, Any], expected: str
) -> None:
    with pytest.raises(CallerError) as found:
        validate(content | {"trigger": trigger}, "here")
    assert str(found.value).startswith(f"here: {expected}")
    assert "\n" not in str(found.value)


def test_an_accumulated_quantity_that_overflows_is_infinite_and_raises_nothing() -> None:
    form = QuadraticForm(np.eye(2), np.zeros((0, 2)))
    assert form.values(np.array([[1e200, 0.0]])) == [math.inf]
