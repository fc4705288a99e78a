"""Objectives of a run against quadrature and dense samples."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from scipy.integrate import quad

from cosim.analysis.adversary.loop_flows import Objective, evaluate, measure_of
from noack.scenario.scenario import Scenario
from tests.cosim.analysis.adversary.scenarios import scenarios, simulate

POINTS = 4001


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
        valued, scaled = evaluate(run, measure), norms / measure.level(t_s)
        assert valued.value >= scaled.max() * (1 - 1e-9)
        assert valued.value == pytest.approx(scaled.max(), rel=1e-3)
        assert valued.at_s is not None
        assert scaled[np.abs(t_s - valued.at_s).argmin()] == pytest.approx(scaled.max(), rel=1e-2)


@given(resolved=scenarios(8))
@settings(max_examples=5)
def test_cost_and_inter_event_time_are_those_of_the_run(resolved: Scenario) -> None:
    run = simulate(resolved, (True, False) * 10)

    def square(t_s: float) -> float:
        return float(np.sum(run.at(np.array([t_s])).x ** 2))

    stops = [0.0, *run.event_s[run.event_s > 0].tolist(), run.horizon_s]
    expected = sum(quad(square, a, b, epsabs=1e-13, epsrel=1e-12)[0] for a, b in pairwise(stops))
    valued = evaluate(run, measure_of(run.system, Objective.COST))
    assert valued.value == pytest.approx(expected, rel=1e-10)
    valued = evaluate(run, measure_of(run.system, Objective.INTER_EVENT))
    between_s = [b - a for a, b in pairwise(run.event_s)]
    assert -valued.value == min(between_s, default=math.inf)
    assert (valued.at_s is None) == (not between_s)
