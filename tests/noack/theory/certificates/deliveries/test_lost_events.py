"""Errors after lost events: simulated loops do not exceed the bounds, which are below sums of norms."""

import math

import numpy as np
import pytest
from scipy.linalg import expm

from noack.theory.bounds.gains import ErrorGains, Output, PlantGains
from noack.theory.certificates.deliveries.delivery_reach import Reach
from noack.theory.certificates.deliveries.invariant_ellipsoids import InvariantEllipsoids
from noack.theory.certificates.deliveries.lost_events import SensorErrors, bend_of_error, errors_after_losses

A, B, K = np.array([[0.0, 1.0], [-1.0, 0.3]]), np.array([[0.0], [1.0]]), np.array([[-0.5, -1.0]])
H = np.array([[-0.1, 1.0], [-1.4, -0.5]])
ALPHA, BETA, LOSSES, STEP_S, UNTIL_S = 0.05, 0.1, 2, 2e-3, 10.0


def simulated(ellipsoid_points: np.ndarray) -> tuple[np.ndarray, float]:
    """Simulate x, x_c and x_s from deliveries with x = x_c = x_s.

    Returns:
        The largest e^{αt}‖e_c‖ while 0, 1, … events have been lost, and the shortest time between two.
    """
    zero = np.zeros((2, 2))
    step = expm(np.block([[A, B @ K, zero], [zero, H, zero], [zero, zero, H]]) * STEP_S)
    signals = np.tile(ellipsoid_points, 3)
    events = np.zeros(len(signals), dtype=int)
    event_s = np.zeros(len(signals))
    largest, shortest_s = np.zeros(LOSSES + 1), math.inf
    for number in range(1, round(UNTIL_S / STEP_S)):
        t_s = number * STEP_S
        signals = signals @ step.T
        x, x_c, x_s = np.split(signals, 3, axis=1)
        errors = math.exp(ALPHA * t_s) * np.linalg.norm(x_c - x, axis=1)
        for lost in range(LOSSES + 1):
            largest[lost] = max(largest[lost], errors[events <= lost].max(initial=0.0))
        is_event = math.exp(ALPHA * t_s) * np.linalg.norm(x_s - x, axis=1) >= BETA
        shortest_s = min(shortest_s, (t_s - event_s)[is_event & (events <= LOSSES)].min(initial=math.inf))
        signals[is_event, 4:] = x[is_event]
        events[is_event] += 1
        event_s[is_event] = t_s
    return largest, shortest_s


@pytest.fixture(scope="module")
def loop() -> tuple[Reach, np.ndarray, float]:
    """The flow from an invariant ellipsoid; the largest simulated errors, and a time between events."""
    plant = PlantGains(ErrorGains(H, K, np.eye(2), ALPHA), A, B, np.array([[1.0], [0.0]]), ALPHA)
    reach = InvariantEllipsoids(plant, (LOSSES + 1) * BETA).reach_within((LOSSES + 1) * BETA)
    assert reach is not None
    angles = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    boundary = reach.scale * directions @ reach.ellipsoid.inverse.T
    points = np.concatenate([share * boundary for share in (0.1, 0.3, 0.5, 0.7, 0.85, 1.0)])
    return reach, *simulated(points)


def bounds_of(reach: Reach, inter_event_s: float) -> tuple[np.ndarray, np.ndarray, float]:
    """The bounds by the flow, those without it, and the inter-event time that they imply."""
    each = np.full(LOSSES + 1, BETA)
    sensor = SensorErrors(each, BETA, 0.0, 0.0, BETA, integrates=False, earliest_due_s=math.inf)
    kernel = reach.ellipsoid.flow.error.kernels[Output.WEIGHTED]
    missing = kernel.sups(inter_event_s * np.arange(LOSSES))
    without_flow = BETA * (1 + np.append(0.0, np.cumsum(missing)))
    bend = bend_of_error(reach, BETA)
    bounds, implied_s = errors_after_losses(reach, without_flow, sensor, [], inter_event_s, bend)
    return bounds, without_flow, implied_s


@pytest.mark.parametrize("share", [0.2, 0.5, 1.0])
def test_no_simulated_error_exceeds_the_bounds_which_are_below_the_sums(
    loop: tuple[Reach, np.ndarray, float], share: float
) -> None:
    reach, largest, shortest_s = loop
    bounds, without_flow, _ = bounds_of(reach, share * shortest_s)
    # Within a step of the simulation e_s grows beyond β by less than 1 %.
    assert (largest <= 1.01 * bounds).all()
    assert (bounds <= without_flow).all()
    assert bounds[LOSSES] < 0.98 * without_flow[LOSSES]
    assert bounds[LOSSES] < 1.3 * largest[LOSSES]


def test_events_are_further_apart_than_was_known_and_as_the_simulation_has_them(
    loop: tuple[Reach, np.ndarray, float],
) -> None:
    reach, _, shortest_s = loop
    _, _, implied_s = bounds_of(reach, 0.2 * shortest_s)
    assert 0.8 * shortest_s < implied_s <= shortest_s
