"""(I1) along a run and the bounds of ‖e_c‖: against explicit sums, and against e_c itself."""

import math
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from noack.core.linear_systems import Matrix, Vector
from noack.theory.paper.error_bounds import ErrorMonitor, MissedEvents, missed_sum
from noack.trigger.trigger_rule import TriggerRule
from tests.oracles.lossy_loops import seeds
from tests.trigger_rules import decaying_rule

STEP_NS = 1_000_000
H = np.array([[-0.3, 1.0, 0.2], [-2.0, -0.1, 0.0], [0.5, 0.0, 0.4]])
GROWTH = max(float(np.linalg.norm(expm(H * t), 2)) for t in np.linspace(0, 13 * 0.4, 100))


@st.composite
def event_histories(draw: st.DrawFn) -> list[tuple[int, bool, int]]:
    """(periods since the measurement before, whether it is an event, newest update received)."""
    measurements, events, newest = [], 0, -1
    for _ in range(draw(st.integers(1, 12))):
        is_event = draw(st.booleans())
        events += is_event
        newest = max(newest, draw(st.integers(-1, events - 1)))  # includes packets out of order
        measurements.append((draw(st.integers(0, 400)), is_event, newest))
    return measurements


@given(event_histories(), st.integers(1, 12), st.integers(0, 2**32))
def test_the_sum_is_the_sum_of_the_propagated_jumps(
    history: list[tuple[int, bool, int]], at_once: int, seed: int
) -> None:
    waits, is_event, received = (np.array(column) for column in zip(*history, strict=True))
    t_ns = np.cumsum(waits) * STEP_NS
    events = np.where(is_event, np.cumsum(is_event) - 1, -1)
    e_s = np.random.default_rng(seed).uniform(-1, 1, (len(history), 3))
    missed = MissedEvents(H, STEP_NS)
    for first in range(0, len(history), at_once):
        part = slice(first, first + at_once)
        found = missed_sum(
            missed.take(t_ns[part], e_s[part], events[part], received[part]), *e_s[part].shape
        )
        for place, total in enumerate(found, first):
            expected = np.zeros(3)
            for then in np.flatnonzero(events[: place + 1] > received[place]):
                expected += expm(H * (t_ns[place] - t_ns[then]) * 1e-9) @ e_s[then]
            # Twelve terms with at most twelve roundings of about 1e-15 each, and their growth.
            np.testing.assert_allclose(total, expected, atol=1e-12 * GROWTH)


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


def follow(history: History, trigger: TriggerRule, at_once: int = 25) -> list[tuple[float, float]]:
    """Return both bounds at each moment; the monitor takes so many moments at once."""
    monitor, found = ErrorMonitor(history.H, trigger, PERIOD_NS), []
    for first in range(0, len(history.moments), at_once):
        columns = zip(*history.moments[first : first + at_once], strict=True)
        t_ns, e_s, events, received, _ = map(np.array, columns)
        bounds = monitor.take(t_ns, e_s, events, received)
        found += zip(bounds.identity.tolist(), bounds.printed.tolist(), strict=True)
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
        assert found == pytest.approx(expected, rel=1e-9, abs=1e-12)


@settings(max_examples=15)
@given(histories())
def test_the_identity_bounds_the_error_for_every_trigger_plant_and_network(
    history: History,
) -> None:
    """No assumption on trigger, plant or network."""
    trigger = decaying_rule(1e-3, 1.0, 0.0, history.weight)
    largest = 0.0
    for moment, found in zip(history.moments, follow(history, trigger), strict=True):
        error = float(np.linalg.norm(history.weight @ moment.e_c))
        largest = max(largest, error)
        assert error <= found[0] + 1e-12 * max(largest, 1.0)
