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
from noack.trigger.trigger_policy import Trigger

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
def test_a_block_of_measurements_gives_the_same_event_as_single_ones(
    content: dict[str, Any], name: str, seed: int
) -> None:
    table = EXAMPLES[name].model_dump(mode="json", exclude_none=True)
    policy = policy_of(resolve(validate(content | {"trigger": table}, "here")))
    at_once, one_by_one = Trigger(policy), Trigger(policy)
    t_ns, z = samples(seed, 400)
    start = np.array([0.5, -0.3])
    for trigger in (at_once, one_by_one):
        trigger.start(0, start)
    decisions = (one_by_one.test(int(t), x[:N], x[N:]) for t, x in zip(t_ns, z, strict=True))
    expected = next((k for k, decision in enumerate(decisions) if decision.event), None)
    found = None
    # in blocks: accumulated quantities continue from block to block
    for begin in range(0, len(z), 32):
        block = slice(begin, begin + 32)
        k = at_once.first_event(t_ns[block], z[block, :N], z[block, N:])
        if k is not None:
            found = begin + k
            break
    assert found == expected


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
