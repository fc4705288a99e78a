"""Properties of every policy, and settings of policies that cannot be applied."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from noack.config.feature_kinds import POLICIES
from noack.config.resolution import policy_of, resolve
from noack.config.scenario_file import validate
from noack.core.errors import CallerError
from noack.trigger.lyapunov import LyapunovSettings
from noack.trigger.policy_settings import ModelMatrices
from noack.trigger.trigger_condition import QuadraticForm
from tests.noack.trigger.core_trigger import CoreTrigger

DYNAMIC = {"policy": "dynamic", "sigma": 0.5, "theta_s": 0.5, "decay_per_s": 0.5}
RULE = {"policy": "quadratic", "Q": [[0.0] * 4] * 4, "period_s": 0.003}
N = 2
EXAMPLES = {
    name: example for name, made in POLICIES.items() if (example := made.example(N)) is not None
}
MS = 1_000_000


def samples(seed: int, k: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Times every 10 ms, and z = (x, e_s) on smooth curves with a growing error."""
    rng = np.random.default_rng(seed)
    t_ns = 10 * MS * np.arange(1, k + 1)
    phase, rate = rng.uniform(0, 6, 2 * N), rng.uniform(0.2, 3, 2 * N)
    z = np.sin(phase + np.outer(t_ns * 1e-9, rate))
    z[:, N:] *= (t_ns * 1e-9)[:, None] * rng.choice([0.01, 0.1, 1.0])
    return t_ns, z


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", EXAMPLES)
def test_the_core_decides_by_the_rules_condition(
    content: dict[str, Any], name: str, seed: int
) -> None:
    table = EXAMPLES[name].model_dump(mode="json", exclude_none=True)
    policy = policy_of(resolve(validate(content | {"trigger": table}, "here")))
    trigger, start = CoreTrigger(policy, N), np.array([0.5, -0.3])
    trigger.start(0, start)
    condition = policy.trigger_rule(N).after(0, start)
    auxiliary, rate = policy.initial_dynamic_variable, 0.0
    if condition.has_auxiliary:
        (rate,) = condition.auxiliary_rates(np.array([[*start, 0.0, 0.0]])).tolist()
    for t_ns, z in zip(*samples(seed, 400), strict=True):
        found = trigger.test(int(t_ns), z[:N], z[N:])
        if condition.has_auxiliary:
            (last,) = condition.auxiliary_rates(z[None]).tolist()
            auxiliary, rate = condition.auxiliary_after(0.01, auxiliary, rate, last), last
        sides = condition.sides(int(t_ns), z[:N], z[N:], auxiliary)
        assert (found.left, found.right) == pytest.approx(sides, rel=1e-9, abs=1e-12)
        if abs(sides.left - sides.right) > 1e-9:
            exceeds = sides.left > sides.right and condition.counts_at(int(t_ns))
            assert found.event == (exceeds or t_ns >= condition.latest_ns)
        if found.event:
            break


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


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_lyapunov_function_beyond_rounding_is_refused() -> None:
    """One mode decays 1e16 times as slowly as the other; P is not positive definite as computed."""
    B, K = (
        np.array([[113.33624038521207], [43.17068933023515]]),
        [[-3.896659939542095, -1.4842666344932138]],
    )
    settings = LyapunovSettings(policy="lyapunov", rate_per_s=0.3)
    with pytest.raises(CallerError, match="within rounding"):
        settings.trigger_policy(ModelMatrices(np.zeros((2, 2)), B, K))
