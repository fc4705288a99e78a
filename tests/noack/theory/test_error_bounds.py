"""(I1) along a run and the bounds of ‖e_c‖: against explicit sums, and against e_c itself."""

import math
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from noack.core.linear_systems import Matrix, Vector
from noack.theory.paper import ErrorMonitor
from noack.trigger.trigger_rule import TriggerRule
from tests.oracles.lossy_loops import seeds
from tests.trigger_rules import decaying_rule

PERIOD_NS = 10_000_000
NS = 1e-9


class Moment(NamedTuple):
    """A measurement: the monitor's arguments, and the true e_c."""

    t_ns: int
    e_s: Vector
    event: int
    received: int
    e_c: Vector


class History(NamedTuple):
    """A run of the two models with an arbitrary plant trajectory."""

    H: Matrix
    weight: Matrix
    moments: list[Moment]


@st.composite
def histories(draw: st.DrawFn) -> History:
    """Random motion of x, random events, updates that arrive late, out of order or never.

    The models follow their own update laws here; (I1) is not used.
    """
    n, rng = draw(st.integers(1, 4)), np.random.default_rng(draw(seeds))
    H = rng.normal(size=(n, n)) if draw(st.booleans()) else np.zeros((n, n))
    H -= rng.uniform(0, 1) * np.eye(n) * H.any()
    weight = np.eye(n) if draw(st.booleans()) else rng.normal(size=(n, n)) + 2 * np.eye(n)
    x = rng.normal(size=n)
    x_s, x_c = x.copy(), x.copy()
    t_ns, received, moments = 0, -1, []
    in_flight: list[tuple[int, int, Vector]] = []
    sent = 0
    for _ in range(draw(st.integers(1, 25))):
        step_ns = int(rng.integers(0, 30)) * PERIOD_NS
        t_ns += step_ns
        moved = expm(H * step_ns * NS)
        x, x_s, x_c = x + rng.normal(size=n), moved @ x_s, moved @ x_c
        e_s, event = x_s - x, -1
        if rng.uniform() < 0.5:
            event, x_s = sent, x.copy()
            sent += 1
            if rng.uniform() < 0.6:  # the others are lost
                in_flight.append((event, t_ns, x.copy()))
        for update in [u for u in in_flight if rng.uniform() < 0.5]:
            in_flight.remove(update)
            sequence, then_ns, state = update
            if sequence > received:
                received, x_c = sequence, expm(H * (t_ns - then_ns) * NS) @ state
        moments.append(Moment(t_ns, e_s, event, received, x_c - x))
    return History(H, weight, moments)


def follow(
    history: History, trigger: TriggerRule, at_once: int = 25
) -> list[tuple[float, float, Vector]]:
    """Return both bounds, and (I1), at each moment; the monitor takes so many moments at once."""
    monitor, found = ErrorMonitor(history.H, trigger, PERIOD_NS), []
    for first in range(0, len(history.moments), at_once):
        columns = zip(*history.moments[first : first + at_once], strict=True)
        t_ns, e_s, events, received, _ = map(np.array, columns)
        bounds = monitor.take(t_ns, e_s, events, received)
        found += zip(bounds.identity.tolist(), bounds.printed.tolist(), bounds.missed, strict=True)
    return found


def explicit(history: History, trigger: TriggerRule, upto: int) -> tuple[float, float]:
    """Both sums, term by term, from the first event on."""

    def threshold(t_ns: int) -> float:
        return max(trigger.level * math.exp(-trigger.rate_per_s * t_ns * NS), trigger.floor)

    H, W, now = history.H, history.weight, history.moments[upto]
    identity = 0.0 if now.event >= 0 else float(np.linalg.norm(W @ now.e_s))
    printed = threshold(now.t_ns)
    for moment in history.moments[: upto + 1]:
        if moment.event > now.received:
            moved = expm(H * (now.t_ns - moment.t_ns) * NS)
            identity += float(np.linalg.norm(W @ moved @ moment.e_s))
            growth = np.linalg.norm(W @ moved @ np.linalg.inv(W), 2)
            printed += threshold(moment.t_ns) * float(growth)
    return identity, printed


@settings(max_examples=15)
@given(histories(), st.floats(0.01, 2.0), st.sampled_from([0.0, 0.3]), st.integers(1, 25))
def test_both_bounds_are_the_explicit_sums(
    history: History, alpha: float, floor: float, at_once: int
) -> None:
    trigger = decaying_rule(0.5, alpha, floor, history.weight)
    for upto, found in enumerate(follow(history, trigger, at_once)):
        expected = explicit(history, trigger, upto)
        assert found[:2] == pytest.approx(expected, rel=1e-9, abs=1e-12)


@settings(max_examples=15)
@given(histories(), st.integers(1, 25))
def test_the_identity_holds_for_every_trigger_plant_and_network(
    history: History, at_once: int
) -> None:
    """It is x_c − x_s, and bounds the error; no assumption on trigger, plant or network."""
    trigger = decaying_rule(1e-3, 1.0, 0.0, history.weight)
    largest = 0.0
    for moment, found in zip(history.moments, follow(history, trigger, at_once), strict=True):
        error = float(np.linalg.norm(history.weight @ moment.e_c))
        largest = max(largest, error)
        assert error <= found[0] + 1e-12 * max(largest, 1.0)
        between = moment.e_c if moment.event >= 0 else moment.e_c - moment.e_s
        np.testing.assert_allclose(found[2], between, rtol=0, atol=1e-9 * max(largest, 1.0))
