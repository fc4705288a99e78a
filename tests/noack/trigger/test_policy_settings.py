"""Properties of every policy, and settings of policies that cannot be applied."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from noack.config.resolution import LoopMatrices, loop_of, resolve, rule_of
from noack.config.scenario_file import validate
from noack.config.sections import POLICIES
from noack.core.errors import CallerError
from noack.trigger.lyapunov import LyapunovSettings
from noack.trigger.policy_settings import ModelMatrices
from tests.noack.trigger.core_trigger import CoreTrigger
from tests.oracles.trigger_rules import Trigger

DYNAMIC = {"policy": "dynamic", "sigma": 0.5, "theta_s": 0.5, "decay_per_s": 0.5}
RULE = {"policy": "quadratic", "Q": [[0.0] * 4] * 4, "period_s": 0.003}
N = 2
EXAMPLES = {
    name: example for name, made in POLICIES.items() if (example := made.example(N)) is not None
}
MS = 1_000_000


def samples(seed: int, k: int) -> tuple[list[int], NDArray[np.float64]]:
    """Times every 10 ms, and z = (x, e_s) on smooth curves with a growing error."""
    rng = np.random.default_rng(seed)
    t_ns = 10 * MS * np.arange(1, k + 1)
    phase, rate = rng.uniform(0, 6, 2 * N), rng.uniform(0.2, 3, 2 * N)
    z = np.sin(phase + np.outer(t_ns * 1e-9, rate))
    z[:, N:] *= (t_ns * 1e-9)[:, None] * rng.choice([0.01, 0.1, 1.0])
    return t_ns.tolist(), z


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", EXAMPLES)
def test_the_core_decides_as_the_rule_is_stated(
    content: dict[str, Any], name: str, seed: int
) -> None:
    table = EXAMPLES[name].model_dump(mode="json", exclude_none=True)
    scenario = resolve(validate(content | {"trigger": table}, "here"))
    loop, start = loop_of(scenario), np.array([0.5, -0.3])
    trigger, stated = CoreTrigger(rule_of(scenario), N), stated_rule(table, loop)
    trigger.start(0, start)
    stated.event(0, start)
    stated.measured(0, start, np.zeros(N))
    for t_ns, z in zip(*samples(seed, 400), strict=True):
        found = trigger.test(t_ns, z[:N], z[N:])
        stated.measured(t_ns, z[:N], z[N:])
        left, right = stated.sides(t_ns, z[:N], z[N:])
        assert (found.left, found.right) == pytest.approx((left, right), rel=1e-9, abs=1e-12)
        if abs(left - right) > 1e-9:
            exceeds = left > right and stated.counts(t_ns, stated.rule)
            assert found.event == (exceeds or t_ns >= stated.due_ns(stated.rule))
        if found.event:
            break


def stated_rule(table: dict[str, Any], loop: LoopMatrices) -> Trigger:
    BK = loop.B_model @ loop.K
    return Trigger(table, loop.A_model + BK, BK)


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
