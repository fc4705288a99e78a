"""Bounds from the newest event: closed forms, an order that is proved, and random scenarios."""

import numpy as np
import pytest
from hypothesis import given, settings
from scipy.linalg import expm

from noack.theory.bounds.gains import ErrorGains, PlantGains
from noack.theory.bounds.terms import Constants
from noack.theory.certificates.certified_bounds import (
    KnownStateBounds,
    KnownStatePart,
)
from tests.oracles.lossy_loops import (
    SEARCH,
    STEPS,
    System,
    certified_or_skipped,
    networks,
    simulate,
    systems,
    times_s,
)

ANY = 10**6


def scalar(**constants: float) -> KnownStateBounds:
    """ẋ = −2x + 3p, H = −1, K = 4, threshold e^{−t/2}; one update in 0.1 s may be missing."""
    models = ErrorGains(np.array([[-1.0]]), np.array([[4.0]]), np.eye(1), 0.5)
    plant = PlantGains(models, np.array([[-14.0]]), np.array([[3.0]]), np.eye(1), 0.5)
    given = {
        "rate_per_s": 0.5, "missing_events": 2, "delta": 2.8, "overshoot": 1.0, "input_error": 9.9,
        "start_error": 0.0, "state": 1.0, "state_weighted": 1.0, "mismatch": 1.0,
        "inter_event_s": 0.2, "loop_gain": 0.5, "received_input_error": 4.1,
    }  # fmt: skip
    part = KnownStatePart(plant, Constants(**given | constants), 1.0)  # type: ignore[arg-type]
    return KnownStateBounds((part,), 0.1, np.zeros((1, 0)))


@pytest.mark.parametrize(
    ("missing", "error", "input_error"),
    [
        (0, 1.0, 4.1),  # 1, and K + q
        (1, 2.0, 8.1),
        (2, 2.8, 9.9),  # 2 + e^{−0.5·0.2} = 2.905 exceeds Δ, 4 · 2.905 + 0.1 exceeds π
        (ANY, 2.8, 9.9),
    ],
)
def test_the_bounds_of_a_scalar_loop(missing: int, error: float, input_error: float) -> None:
    t_s, count = np.array([2.0]), np.array([missing])
    decay = np.exp(-1.0)
    assert scalar().controller_error(t_s, count) == pytest.approx([error * decay], rel=1e-6)
    # ∫ 3e^{−1.5s} p̃(t−s): π over the 0.1 s after the event, which are the oldest ones.
    whole, known = 2 * (1 - np.exp(-1.5)), 2 * (1 - np.exp(-1.5 * 0.9))
    exact = (input_error * known + 9.9 * (whole - known)) * decay
    found = scalar().state_deviation(t_s, np.array([1.0]), count)
    assert exact <= found <= 1.03 * exact


@settings(SEARCH, max_examples=15)
@given(systems(beta=0.01, mismatch=0.5, delay_steps=0, hold_steps=0))
def test_a_later_event_gives_a_smaller_bound(system: System) -> None:
    """If nothing is known about losses, the newest event gives the smallest bound of ‖x‖."""
    bounds = KnownStateBounds(
        (KnownStatePart(system.gains(), certified_or_skipped(system), system.beta),),
        system.conditions.delay_s,
        np.zeros((len(system.A), 0)),
    )
    trace = simulate(system, *(array[:8] for array in networks(1, system)))
    moved = expm((system.A + system.B @ system.K) * system.step_s)
    t_s = times_s(system)
    for x, is_event in zip(trace.x, trace.is_event, strict=True):
        best = np.full(STEPS, np.inf)
        for event in np.flatnonzero(is_event):
            predicted = [x[event]]
            for _ in range(STEPS - event - 1):
                predicted.append(moved @ predicted[-1])
            age_s, counts = t_s[: STEPS - event], np.full(STEPS - event, ANY)
            deviation = bounds.state_deviation(t_s[event:], age_s, counts)
            found = np.linalg.norm(predicted, axis=1) + deviation
            # The integrals are enclosed with an accuracy of about 1 %.
            assert (found <= best[event:] * 1.01 + 0.01 * deviation).all()
            best[event:] = np.minimum(best[event:], found)
