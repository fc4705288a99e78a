"""Segments, objectives and polynomial curves against the reference simulator and quadrature."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from scipy.integrate import quad

from cosim.analysis.adversary.loss_patterns import follow
from cosim.analysis.adversary.objective import Objective, measure_of
from cosim.analysis.adversary.pattern_evaluation import evaluate
from cosim.analysis.adversary.polynomial_curves import Stack, curve_stack, peak_squares, powers
from cosim.simulation.continuous.bernstein import curve_basis
from cosim.simulation.continuous.continuous_loop import LoopState
from noack.config.scenario import Scenario
from noack.impairments.loss_guarantee import LossAutomaton
from tests.cosim.analysis.adversary.scenarios import flow_of, scenarios, simulate

STATES = 10
POINTS = 4001
DEGREE = 18


@given(resolved=scenarios(12))
@settings(max_examples=8)
def test_events_are_those_of_the_reference(resolved: Scenario) -> None:
    """Both are exact up to rounding; an almost tangential crossing amplifies the rounding error."""
    flow = flow_of(resolved, Objective.INTER_EVENT)
    system, rng, n = flow.system, np.random.default_rng(0), flow.system.loop.n
    t_s = rng.uniform(0, resolved.horizon_s, STATES)
    z = rng.uniform(-1, 1, (STATES, 3 * n))
    z[:, n : 2 * n] = 0.0
    found = flow(t_s, z)
    for i in range(STATES):
        start = LoopState(t_s[i], *np.split(z[i], 3))
        crossing = system.next_crossing(start, resolved.horizon_s, system.condition(start))
        expected = None if crossing is None else crossing[0]
        assert found.is_event[i] == (expected is not None)
        if expected is not None:
            assert found.end_s[i] == pytest.approx(expected.t_s, rel=1e-9)
            assert found.value[i] == t_s[i] - found.end_s[i]
        else:
            assert found.end_s[i] == resolved.horizon_s
            expected = system.propagate(start, resolved.horizon_s)
        size = np.abs(np.concatenate(expected[1:])).max()
        np.testing.assert_allclose(found.z[i], np.concatenate(expected[1:]), atol=1e-8 * size)


@given(resolved=scenarios(12))
@settings(max_examples=6)
def test_the_value_of_a_pattern_is_that_of_its_run(resolved: Scenario) -> None:
    """The loop amplifies the rounding of event times; the supremum's own resolution is 1e-6."""
    rng = np.random.default_rng(0)
    wanted = [tuple(row) for row in (rng.uniform(size=(4, 15)) < 0.5).tolist()]
    first = () if resolved.network.initial_sync == "known_state" else (True,)
    runs = [simulate(resolved, first + pattern) for pattern in wanted]
    for objective in Objective:
        flow = flow_of(resolved, objective)
        values, patterns = follow(flow, LossAutomaton(resolved.network.guarantee), wanted)
        for value, pattern, run in zip(values, patterns, runs, strict=True):
            assert tuple(run.delivered.tolist()) == first + pattern
            assert value == pytest.approx(evaluate(run, flow.measure).value, rel=1e-6)


@given(resolved=scenarios(12))
@settings(max_examples=8)
def test_a_supremum_is_just_above_all_samples(resolved: Scenario) -> None:
    """Between samples, a norm exceeds them by at most the squared spacing times its curvature."""
    run = simulate(resolved, (False,) * 20)
    t_s = np.linspace(0.0, run.horizon_s, POINTS)
    just_before_s = np.nextafter(run.event_s[run.event_s > 0], 0)
    t_s = np.sort(np.concatenate([t_s, just_before_s]))
    samples = run.at(t_s)
    for objective, norms in (
        (Objective.ERROR, run.e_c_norm(samples) / run.system.decaying.beta),
        (Objective.STATE, np.linalg.norm(samples.x, axis=1)),
    ):
        measure = measure_of(run.system, objective)
        found, scaled = evaluate(run, measure), norms / measure.level(t_s)
        assert found.value >= scaled.max() * (1 - 1e-9)
        assert found.value == pytest.approx(scaled.max(), rel=1e-3)
        assert found.at_s is not None
        assert scaled[np.abs(t_s - found.at_s).argmin()] == pytest.approx(scaled.max(), rel=1e-2)


@given(resolved=scenarios(8))
@settings(max_examples=5)
def test_cost_and_inter_event_time_are_those_of_the_run(resolved: Scenario) -> None:
    run = simulate(resolved, (True, False) * 10)

    def square(t_s: float) -> float:
        return float(np.sum(run.at(np.array([t_s])).x ** 2))

    stops = [0.0, *run.event_s[run.event_s > 0].tolist(), run.horizon_s]
    expected = sum(quad(square, a, b, epsabs=1e-13, epsrel=1e-12)[0] for a, b in pairwise(stops))
    found = evaluate(run, measure_of(run.system, Objective.COST))
    assert found.value == pytest.approx(expected, rel=1e-10)
    found = evaluate(run, measure_of(run.system, Objective.INTER_EVENT))
    between_s = [b - a for a, b in pairwise(run.event_s)]
    assert -found.value == min(between_s, default=math.inf)
    assert (found.at_s is None) == (not between_s)


def curves(seed: int, count: int, size: float) -> Stack:
    """Smooth curves that cross the unit sphere never, once or several times."""
    falling = 1.0 / np.cumprod([1.0, *(np.arange(1.0, DEGREE + 1) / 6)])
    rng = np.random.default_rng(seed)
    return np.asarray(size * falling[:, None] * rng.normal(size=(count, DEGREE + 1, 2)))


@pytest.mark.parametrize("size", [0.2, 0.5, 1.0])
def test_first_exits_are_those_of_single_curves(size: float) -> None:
    taylor = curves(0, 300, size)
    found = curve_stack(DEGREE).first_exits(taylor)
    expected = [curve_basis(DEGREE).first_exit(one) for one in taylor]
    assert np.isnan(found).tolist() == [u is None for u in expected]
    crossed = ~np.isnan(found)
    assert crossed.any()
    reference = [u for u in expected if u is not None]
    np.testing.assert_allclose(found[crossed], reference, rtol=0, atol=1e-9)


def test_a_peak_is_the_maximum_of_its_neighbourhood() -> None:
    """Against 10,001 points; their squared spacing times the curvature is below 1e-8."""
    taylor = curves(1, 100, 1.0)
    grid = np.linspace(0.0, 1.0, 10_001)
    squares = ((powers(grid, DEGREE) @ taylor) ** 2).sum(axis=2)
    at, reach = grid[squares[:, ::100].argmax(axis=1) * 100], 0.01
    near = np.abs(grid - at[:, None]) <= reach
    expected = np.where(near, squares, 0.0).max(axis=1)
    found = peak_squares(taylor, at, reach)
    assert (found >= expected * (1 - 1e-12)).all()
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_bernstein_coefficients_enclose_and_halve() -> None:
    stack = curve_stack(DEGREE)
    for one in curves(2, 20, 1.0):
        coefficients = stack.squares(one[None])[0]
        squares = ((powers(np.linspace(0.0, 1.0, 101), DEGREE) @ one) ** 2).sum(axis=1)
        assert coefficients.max() >= squares.max() * (1 - 1e-12)
        assert coefficients[[0, -1]] == pytest.approx(squares[[0, -1]])
        left, right = stack.halves(coefficients)
        assert left[-1] == right[0] == pytest.approx(squares[50])
        assert max(left.max(), right.max()) <= coefficients.max() * (1 + 1e-12)
