"""Segments and objectives against single runs, quadrature and dense samples."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from scipy.integrate import quad

from cosim.analysis.adversary.loop_flows import evaluate
from cosim.analysis.adversary.objective import Objective, measure_of
from cosim.analysis.adversary.pattern_search import follow
from cosim.simulation.continuous import LoopState
from noack.impairments.loss_guarantee import LossAutomaton
from noack.scenario.scenario import Scenario
from tests.cosim.analysis.adversary.scenarios import flow_of, scenarios, simulate
from tests.cosim.simulation.continuous.next_event import next_event

STATES = 10
POINTS = 4001


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
        expected = next_event(system, start, resolved.horizon_s)
        assert found.is_event[i] == (expected is not None)
        if expected is not None:
            assert found.end_s[i] == pytest.approx(expected.t_s, rel=1e-9)
            assert found.value[i] == t_s[i] - found.end_s[i]
        else:
            assert found.end_s[i] == resolved.horizon_s
            expected = system.sample(start, np.array([resolved.horizon_s]))
        ended = np.concatenate(expected[1:], axis=None)
        np.testing.assert_allclose(found.z[i], ended, atol=1e-8 * np.abs(ended).max())


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
        (Objective.ERROR, run.e_c_norm(samples) / run.system.decaying.level),
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
