"""Every policy at measurements, against the rules as they are stated; mistakes in settings.

The table of all policies is in tests/trigger_rules.py. Here each is applied at measurements; in
tests/cosim/simulation/batch/test_exact_events.py in continuous time; in
tests/cosim/analysis/adversary/test_worst_patterns.py by the search for the worst pattern.
"""

import numpy as np
import pytest

from noack.core.core_library import CoreMemory, core, ffi
from noack.core.errors import CallerError
from noack.core.linear_systems import Vector
from noack.scenario.sections import POLICIES
from noack.trigger.deadline import DeadlineSettings
from noack.trigger.lyapunov import LyapunovSettings
from noack.trigger.policy_settings import ModelMatrices
from noack.trigger.trigger_rule import TriggerDecision, TriggerRule, fill_rule, rule_rows
from tests.oracles.trigger_rules import Trigger
from tests.trigger_rules import TABLES, drawn, rule_from


class CoreTrigger:
    """A policy that native/loop/trigger.c applies to n states."""

    def __init__(self, rule: TriggerRule, n: int) -> None:
        self._memory, self._n = CoreMemory(), n
        self._rule, self._state = ffi.new("noack_trigger_rule *"), ffi.new("noack_trigger_state *")
        fill_rule(self._rule, rule, n, self._memory)
        self._state.auxiliary = self._rule.initial
        self._scratch = self._memory.zeros(2 * n + rule_rows(rule))

    def start(self, t_ns: int, x: Vector) -> None:
        """Begin, or begin again after an event."""
        core.noack_trigger_start(*self._arguments(t_ns, x), self._scratch)

    def test(self, t_ns: int, x: Vector, e_s: Vector) -> TriggerDecision:
        """Decide whether a measurement is an event."""
        sides = np.zeros(2)
        event = core.noack_trigger_test(
            *self._arguments(t_ns, x), self._vector(e_s),
            ffi.cast("double *", sides.ctypes.data), self._scratch,
        )  # fmt: skip
        return TriggerDecision(bool(event), *sides.tolist())

    def _arguments(self, t_ns: int, x: Vector) -> tuple[object, ...]:
        return self._rule, self._state, self._n, t_ns, self._vector(x)

    def _vector(self, values: Vector) -> object:
        return ffi.new("double[]", values.tolist())


N, MS = 2, 10**6


def samples(seed: int, k: int) -> tuple[list[int], Vector]:
    """Times every 10 ms, and z = (x, e_s) on smooth curves with a growing error."""
    rng = np.random.default_rng(seed)
    t_ns = 10 * MS * np.arange(1, k + 1)
    phase, rate = rng.uniform(0, 6, 2 * N), rng.uniform(0.2, 3, 2 * N)
    z = np.sin(phase + np.outer(t_ns * 1e-9, rate))
    z[:, N:] *= (t_ns * 1e-9)[:, None] * rng.choice([0.01, 0.1, 1.0])
    return t_ns.tolist(), z


def test_every_rule_is_in_the_table() -> None:
    assert {table["policy"] for table in TABLES.values()} == POLICIES.keys() - {"python"}


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("name", TABLES)
def test_the_core_decides_as_the_rule_is_stated(name: str, seed: int) -> None:
    rng, start = np.random.default_rng(seed), np.array([0.5, -0.3])
    table = drawn(TABLES[name], rng, N, np.array([[2.0, 0.5], [0.0, 1.0]]) if seed % 2 else None)
    A, B, K = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.array([[-1.0, -1.5]])
    rule = rule_from(table, ModelMatrices(A, B, K))
    trigger, stated = CoreTrigger(rule, N), Trigger(table, A + B @ K, B @ K)

    def begin(t_ns: int, x: Vector) -> None:
        trigger.start(t_ns, x)
        stated.event(t_ns, x)
        stated.measured(t_ns, x, np.zeros(N))

    begin(0, start)
    for t_ns, z in zip(*samples(seed, 400), strict=True):
        found = trigger.test(t_ns, z[:N], z[N:])
        stated.measured(t_ns, z[:N], z[N:])
        left, right = stated.sides(t_ns, z[:N], z[N:])
        assert (found.left, found.right) == pytest.approx((left, right), rel=1e-9, abs=1e-12)
        if abs(left - right) > 1e-9 or left == right == 0.0:
            exceeds = left > right and stated.counts(t_ns, stated.rule)
            assert found.event == (exceeds or t_ns >= stated.due_ns(stated.rule))
        if found.event:
            begin(t_ns, z[:N])


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


def test_the_same_threshold_from_a_later_origin() -> None:
    rule = {"policy": "decaying", "beta": 0.5, "alpha_per_s": 0.25}
    deadline = DeadlineSettings(policy="deadline", rule=rule, interval_s=1.0)
    assert deadline.at_origin(3.0).rule.beta == pytest.approx(0.5 * np.exp(-0.75), rel=1e-12)
