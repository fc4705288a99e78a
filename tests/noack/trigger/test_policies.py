"""The rule of each policy, written a second time, and its known properties."""

import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from noack.core.linear_systems import norm as exact_norm
from noack.trigger.trigger_rule import Forecast, Policy
from tests.noack.trigger.core_trigger import CoreTrigger
from tests.trigger_rules import (
    absolute_rule,
    decaying_rule,
    dynamic_rule,
    lyapunov_rule,
    mixed_rule,
    periodic_rule,
    quadratic_rule,
    self_triggered_rule,
    with_deadline,
    with_dwell_time,
)

Vector = NDArray[np.float64]
MS = 1_000_000
S = 1_000_000_000
W = np.array([[2.0, 0.5], [0.0, 1.0]])
P = np.array([[2.0, 0.3], [0.3, 1.0]])
Q = np.array([[1.0, 0.2], [0.2, 0.5]])
BK = np.array([[0.0, 0.0], [1.0, -4.0]])
FORM = np.array([
    [-0.1, 0.0, 0.02, 0.0],
    [0.0, -0.1, 0.0, 0.01],
    [0.02, 0.0, 1.0, 0.1],
    [0.0, 0.01, 0.1, 2.0],
])  # fmt: skip

vectors = st.lists(st.floats(-3, 3), min_size=2, max_size=2).map(np.array)
Rule = Callable[[float, Vector, Vector, Vector], float]
"""Positive at an event; a function of t in s, x, e_s and the state at the last event (t = 0)."""

STATIC: dict[str, tuple[Policy, Rule]] = {
    "decaying": (
        decaying_rule(0.5, 0.25, 0.01, W),
        lambda t, x, e, x_k: norm(W @ e) - max(0.5 * math.exp(-0.25 * t), 0.01),
    ),
    "absolute": (absolute_rule(0.3, W), lambda t, x, e, x_k: norm(W @ e) - 0.3),
    "relative": (
        mixed_rule(0.2, 0.0, W), lambda t, x, e, x_k: norm(W @ e) - 0.2 * norm(W @ x)
    ),
    "mixed": (
        mixed_rule(0.2, 0.1),
        lambda t, x, e, x_k: norm(e) ** 2 - (0.2 * norm(x)) ** 2 - 0.1**2,
    ),
    "quadratic": (
        quadratic_rule(FORM, MS, 0.05),
        lambda t, x, e, x_k: (z := np.concatenate([x, e])) @ FORM @ z - 0.05,
    ),
    "lyapunov": (
        lyapunov_rule(np.linalg.cholesky(P).T, 0.7),
        lambda t, x, e, x_k: x @ P @ x - (x_k @ P @ x_k) * math.exp(-0.7 * t),
    ),
}  # fmt: skip


def norm(v: Vector) -> float:
    return float(np.linalg.norm(v))


@pytest.mark.parametrize("name", STATIC)
@given(data=st.data())
def test_the_rule_is_the_published_one(name: str, data: st.DataObject) -> None:
    policy, rule = STATIC[name]
    x_k, x, e = (data.draw(vectors) for _ in range(3))
    t_ms = data.draw(st.integers(1, 20_000))
    trigger = CoreTrigger(policy, 2)
    trigger.start(0, x_k)
    found, excess = trigger.test(t_ms * MS, x, e), rule(t_ms / 1000, x, e, x_k)
    if abs(excess) > 1e-9:
        assert found.event == (excess > 0)
        assert (found.left > found.right) == (excess > 0)


@given(st.lists(st.tuples(vectors, vectors), min_size=1, max_size=12), st.floats(0.1, 5.0))
def test_the_dynamic_rule_integrates_its_variable(
    samples: list[tuple[Vector, Vector]], theta_s: float
) -> None:
    """η between samples as the solution of η̇ = −λη + w with w held."""
    policy = dynamic_rule(0.3, theta_s, 0.8, P, Q, BK, eta_0=0.2)
    trigger, eta, w = CoreTrigger(policy, 2), 0.2, 0.0
    trigger.start(0, np.zeros(2))
    for number, (x, e) in enumerate(samples, 1):
        found = trigger.test(number * 10 * MS, x, e)
        eta = math.exp(-0.8 * 0.01) * eta + (1 - math.exp(-0.8 * 0.01)) / 0.8 * w
        w = 0.3 * x @ Q @ x - 2 * x @ P @ BK @ e
        excess = -(max(eta, 0.0) + theta_s * w)
        if abs(excess) > 1e-9:
            assert found.event == (excess > 0)


def events_ms(policy: Policy, error: Callable[[int, int], float]) -> Iterator[int]:
    """Events in the first second, tested every ms; the error depends on the last event's age."""
    trigger, last = CoreTrigger(policy, 2), 0
    trigger.start(0, np.ones(2))
    for t_ms in range(1, 1001):
        if trigger.test(t_ms * MS, np.ones(2), np.full(2, error(t_ms, t_ms - last))).event:
            yield t_ms
            last = t_ms
            trigger.start(t_ms * MS, np.ones(2))


def growing(t_ms: int, since_ms: int) -> float:
    return 1e-3 * since_ms


def silent(t_ms: int, since_ms: int) -> float:
    return 0.0


def test_periodic_transmits_at_a_fixed_period() -> None:
    assert list(events_ms(periodic_rule(70 * MS), growing)) == list(range(70, 1001, 70))


def test_a_deadline_only_adds_an_event_after_silence() -> None:
    rule = absolute_rule(0.1)  # after 71 ms of growth
    assert list(events_ms(with_deadline(rule, 200 * MS), silent)) == list(range(200, 1001, 200))
    assert list(events_ms(with_deadline(rule, 200 * MS), growing)) == list(events_ms(rule, growing))
    assert next(events_ms(with_deadline(rule, 50 * MS), growing)) == 50


def test_a_dwell_time_only_delays_events() -> None:
    rule = absolute_rule(0.1)
    assert next(events_ms(rule, growing)) == 71
    assert list(events_ms(with_dwell_time(rule, 100 * MS), growing)) == list(range(100, 1001, 100))
    assert list(events_ms(with_dwell_time(rule, 50 * MS), growing)) == list(
        events_ms(rule, growing)
    )
    assert next(events_ms(with_dwell_time(periodic_rule(30 * MS), 50 * MS), silent)) == 50
    assert list(events_ms(with_dwell_time(rule, 50 * MS), silent)) == []


def test_periodic_event_triggering_tests_on_its_grid_and_has_a_heartbeat() -> None:
    Q = np.diag([0.0, 0.0, 1.0, 1.0])
    assert list(events_ms(quadratic_rule(Q, 50 * MS, 0.01), growing)) == list(range(100, 1001, 100))
    silent_events = list(events_ms(quadratic_rule(Q, 50 * MS, 0.01, heartbeat=6), silent))
    assert silent_events == [300, 600, 900]


@given(
    st.floats(0.0, 20.0), st.floats(0.0, 5.0), st.floats(0.0, 5.0), vectors, st.floats(0.0, 0.2),
    st.floats(0.0, 30.0),
)  # fmt: skip
def test_a_self_triggered_error_stays_below_the_threshold(
    L: float, a: float, b: float, x: Vector, floor: float, t_s: float
) -> None:
    """The extreme error d|e|/dt = L|e| + a|x| + b reaches it at the event, and not before."""
    policy = self_triggered_rule(Forecast(0.5, 0.25, floor, L, a, b), 1000, 10 * S)
    trigger, t_ns = CoreTrigger(policy, len(x)), round(t_s * 1e9)
    trigger.start(t_ns, x)
    tau_s, t_s = (trigger.latest_ns - t_ns) * 1e-9, t_ns * 1e-9

    def error(tau: float) -> float:
        grown = math.expm1(L * tau) / L if L * tau > 1e-9 else tau
        return (a * norm(x) + b) * grown

    def threshold(tau: float) -> float:
        return max(0.5 * math.exp(-0.25 * (t_s + tau)), floor)

    if tau_s > 2e-6:  # the core's times are whole nanoseconds
        assert error(tau_s) <= threshold(tau_s) * (1 + 1e-6)
    if 2e-6 < tau_s < 10 - 1e-6:
        later = tau_s + 1e-8 * (1 + t_s)
        assert error(later) >= threshold(later) * (1 - 1e-6)


@given(st.lists(st.floats(allow_nan=False), min_size=2, max_size=2).map(np.array), vectors)
def test_the_compared_error_has_the_bits_of_its_norm(e_s: Vector, x: Vector) -> None:
    """Also if a run diverges: its squares overflow."""
    trigger = CoreTrigger(absolute_rule(0.1), 2)
    trigger.start(0, x)
    with np.errstate(over="ignore"):
        assert trigger.test(MS, x, e_s).left == exact_norm(e_s)
