"""Balls from delivery to delivery: by hand, and what a return of their centres may change."""

import math
from itertools import islice
from unittest.mock import patch

import numpy as np
import pytest
from scipy.linalg import expm

from noack.theory.bounds.certificate_terms import Constants, InterEventTimes, NetworkConditions, TriggerBound
from noack.theory.bounds.gains import ErrorGains, Output, PlantGains
from noack.theory.certificates.deliveries import due_deliveries
from noack.theory.certificates.deliveries.delivery_balls import Ball, BallHistory
from noack.theory.certificates.deliveries.due_deliveries import Deliveries, outputs_after_return

a, b, k, ALPHA, STEP_S, DELAY_S, X0 = 0.5, 2.0, -0.7, 0.05, 0.4, 0.2, 3.0
"""A scalar loop with a zero-order hold that transmits every 0.4 s."""


def scalar_loop(delay_s: float) -> Deliveries:
    models = ErrorGains(np.zeros((1, 1)), np.array([[k]]), np.eye(1), ALPHA)
    plant = PlantGains(models, np.array([[a]]), np.array([[b]]), np.array([[X0]]), ALPHA)
    conditions = NetworkConditions(0, STEP_S, STEP_S, delay_s)
    return Deliveries(plant, conditions, TriggerBound(0.0, None, times=InterEventTimes(STEP_S, STEP_S)))


def state_after(r_s: np.ndarray) -> np.ndarray:
    """x(r)/x(0) while u = k x(0)."""
    return np.exp(a * r_s) * (1 + b * k / a) - b * k / a


def test_the_bounds_of_a_scalar_loop_are_its_largest_values() -> None:
    """It decays from event to event, so they are those of the first gap."""
    constants = scalar_loop(0.0).constants(1.0)
    r_s = np.linspace(0.0, STEP_S, 2001)
    grown, state = np.exp(ALPHA * r_s), state_after(r_s)
    for bound, values in (
        (constants.state, grown * state),
        (constants.input_error, k * grown * (1 - state)),
        (constants.mismatch, (a + b * k) * grown * state),
    ):
        largest = X0 * float(np.abs(values).max())
        assert largest <= bound <= 1.002 * largest


def test_the_balls_of_a_late_scalar_loop_follow_the_recursion_by_hand() -> None:
    """While an update is late, u is up to S away, which moves x by ``late_gain`` · S until the next event."""
    phi = math.exp(ALPHA * STEP_S) * float(state_after(np.array(STEP_S)))
    error = math.exp(ALPHA * STEP_S) - phi
    rate = a + ALPHA
    late_gain = b * (math.exp(rate * STEP_S) - math.exp(rate * (STEP_S - DELAY_S))) / rate
    removed = math.exp(ALPHA * DELAY_S) * abs(k)
    loop = scalar_loop(DELAY_S)
    unit = float(abs(loop.gains.scaling[0, 0]))
    centre, rho, S = X0, 0.0, 0.0
    for number, (times, balls) in enumerate(islice(loop.balls(), 8), 1):
        rho, S = (
            abs(phi) * rho + late_gain * S,
            removed * (abs(error) * (abs(centre) + rho) + late_gain * S),
        )
        centre *= phi
        (ball,) = balls
        assert [ball.time] == [*times] == [number]
        assert abs(ball.centre[0]) / unit == pytest.approx(abs(centre))
        assert rho <= ball.radius / unit <= 1.02 * rho + 1e-9
        assert S <= ball.late_effects <= 1.02 * S


def test_the_outputs_of_a_ball_are_those_of_its_largest_state_and_late_update() -> None:
    deliveries, rho, S = scalar_loop(DELAY_S), 1.0, 0.5
    unit, theta = float(abs(deliveries.gains.scaling[0, 0])), deliveries.gains.theta
    ball = Ball(np.zeros(1), unit * rho, S, unit * rho + theta * S, theta)
    bounds = dict(zip(deliveries.loop.outputs, deliveries.outputs_until_next_delivery([ball]), strict=True))
    r_s, rate = np.linspace(0.0, STEP_S + DELAY_S, 2001), a + ALPHA
    by_late_input = b * (np.exp(rate * r_s) - np.exp(rate * (r_s - DELAY_S).clip(min=0.0))) / rate
    largest = float((rho * np.abs(np.exp(ALPHA * r_s) * state_after(r_s)) + S * by_late_input).max())
    # A late input is counted for up to one cell longer.
    by_one_cell = S * b * deliveries.loop.grid.cell_s * math.exp(rate * (STEP_S + DELAY_S))
    assert largest <= bounds[Output.STATE] <= 1.02 * (largest + by_one_cell)


@pytest.mark.parametrize("largest_before", [0.1, 10.0])
def test_the_bound_of_the_rest_is_that_of_all_later_outputs_of_the_recursion(largest_before: float) -> None:
    """Later outputs are at most κ times an earlier one, plus what the rest causes."""
    kappa, of_rest = 0.8, np.array([0.0, 0.03, 0.2, 3.0])
    output = np.full(len(of_rest), largest_before)
    bound = outputs_after_return(kappa, output, of_rest)
    later = []
    for _ in range(300):
        output = kappa * output + of_rest
        later.append(output)
    assert bound == pytest.approx(np.max(later, axis=0))


DECAY, SLOW_STEP_S = 0.02, 0.1
MODES = np.block(
    [
        [np.array([[-DECAY, 1.0], [-1.0, -DECAY]]), np.zeros((2, 2))],
        [np.zeros((2, 2)), np.array([[-DECAY, 5.0], [-5.0, -DECAY]])],
    ]
)
INPUT, GAIN, START = np.eye(4)[:, 1:2], -0.001 * np.eye(4)[1:2], np.array([1.0, 0.5, 0.0, 0.0])


def slow_loop(dropouts: int) -> Deliveries:
    """Two oscillators that decay slowly; the faster one, whose E x is larger, is at rest."""
    alpha = 0.2 * DECAY
    models = ErrorGains(np.zeros((4, 4)), GAIN, np.eye(4), alpha)
    plant = PlantGains(models, MODES, INPUT, START[:, None], alpha)
    conditions = NetworkConditions(dropouts, SLOW_STEP_S, SLOW_STEP_S)
    return Deliveries(
        plant, conditions, TriggerBound(0.0, None, times=InterEventTimes(SLOW_STEP_S, SLOW_STEP_S))
    )


def without_return(loop: Deliveries) -> Constants:
    with patch.object(BallHistory, "last_return", lambda history, last: None):
        return loop.constants(1.0)


@pytest.mark.parametrize("dropouts", [0, 1])
def test_a_return_makes_no_bound_larger(dropouts: int) -> None:
    for loop in (slow_loop(dropouts), scalar_loop(DELAY_S)):
        with_return, alone = loop.constants(1.0), without_return(loop)
        for name in ("state", "state_weighted", "mismatch", "input_error", "delta"):
            assert getattr(with_return, name) <= getattr(alone, name) * (1 + 1e-12), name


def test_a_return_bounds_the_rest_of_a_slow_loop_before_its_norm_has_decayed() -> None:
    """The bound holds in an exact simulation that is longer than the balls are followed."""
    with patch.object(due_deliveries, "MOST_TIMES", 200):
        with_return, alone = slow_loop(0).constants(1.0), without_return(slow_loop(0))
    assert with_return.mismatch < 0.9 * alone.mismatch
    drift = np.block([[MODES, INPUT @ GAIN], [np.zeros((4, 8))]])
    step = math.exp(with_return.rate_per_s * SLOW_STEP_S) * expm(drift * SLOW_STEP_S)
    x, largest = START, 0.0
    for _ in range(4000):
        largest = max(largest, float(np.linalg.norm((MODES + INPUT @ GAIN) @ x)))
        x = (step @ np.append(x, x))[:4]
    assert largest <= with_return.mismatch
