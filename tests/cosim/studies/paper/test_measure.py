"""Measures of a draw, against closed forms and against the simulator's own summary."""

import math

import numpy as np
import pytest
from scipy.linalg import expm

from cosim.simulation.continuous.continuous_report import run_continuous, summary
from cosim.studies.paper.draw_measures import (
    MODES,
    Draw,
    _ideal_norms,
    _settling_s,
    certified,
    measure_draw,
    open_loop_eigenvalues,
    printed,
    resolved_draw,
)
from cosim.studies.paper.paper_campaign import BASE, EXACT_MODEL, load_campaign
from noack.config.resolution import loop_of

_, SCENARIOS = load_campaign()
SCENARIO = SCENARIOS[BASE]
DRAW = 3


@pytest.fixture(scope="module")
def found() -> Draw:
    return measure_draw(SCENARIO, DRAW)


def test_the_settling_time_of_an_exponential_is_its_closed_form() -> None:
    t_s = np.linspace(0.0, 10.0, 101)
    assert _settling_s(t_s, np.exp(-t_s), 0.05) == pytest.approx(math.log(20), rel=1e-12)


def test_settling_counts_from_the_last_time_above_the_level() -> None:
    t_s = np.arange(5.0)
    assert _settling_s(t_s, np.array([1.0, 0.01, 1.0, 0.01, 0.01]), 0.1) == pytest.approx(2.5)
    assert _settling_s(t_s, np.full(5, 0.01), 0.1) == 0.0
    assert _settling_s(t_s, np.array([1.0, 0.0, 0.0, 0.0, 1.0]), 0.1) == math.inf


def test_the_loop_without_a_network_is_the_matrix_exponential() -> None:
    loop = loop_of(resolved_draw(SCENARIO, DRAW, "model"))
    closed = loop.A + loop.B @ loop.K
    t_s, norms = _ideal_norms(closed, loop.x0, 20.0)
    for k in (0, 137, 2000):
        assert norms[k] == pytest.approx(np.linalg.norm(expm(closed * t_s[k]) @ loop.x0), rel=1e-10)


def test_other_draws_have_other_plants_starts_and_losses() -> None:
    first, second = (resolved_draw(SCENARIO, draw, "model") for draw in (0, 1))
    assert first.plant.A != second.plant.A
    assert first.plant.initial_state != second.plant.initial_state
    assert first.seeds.loss != second.seeds.loss


def test_measures_agree_with_the_simulators_summary(found: Draw) -> None:
    model, zoh = (resolved_draw(SCENARIO, DRAW, mode) for mode in MODES)
    assert model.model_copy(update={"mode": "zoh"}) == zoh
    fates = []
    for measures, resolved in ((found.model, model), (found.zoh, zoh)):
        run = run_continuous(resolved)
        fates.append(run.delivered)
        expected = summary(run, resolved)
        assert measures.events == expected["events"]
        assert measures.deliveries == expected["deliveries"]
        assert measures.gap_min_s == expected["inter_event_min_s"]
        assert measures.gap_median_s == expected["inter_event_median_s"]
        assert measures.reception_median_s == expected["inter_delivery_median_s"]
        assert measures.final_norm == pytest.approx(expected["final_state_norm"], rel=1e-9)
        assert found.start_norm == pytest.approx(expected["initial_state_norm"], rel=1e-9)
        assert measures.peak >= 1
    common = min(map(len, fates))
    assert (fates[0][:common] == fates[1][:common]).all()
    assert not fates[0].all()


def test_measured_values_are_within_the_certified_and_printed_bounds(found: Draw) -> None:
    bound, theorem = (f(SCENARIO, DRAW) for f in (certified, printed))
    assert 1 < found.model.controller_error <= bound.delta
    assert found.start_norm <= found.model.envelope <= bound.state
    assert theorem.inter_event_s < bound.inter_event_s < found.model.gap_min_s
    # eq:tau for every t_i is the smaller of its two end values, for either sign of F̄'s slope.
    assert theorem.inter_event_s == pytest.approx(min(theorem.first_s, theorem.late_s), rel=1e-9)


def test_the_double_eigenvalue_at_zero_is_recognised_in_every_plant() -> None:
    for draw in range(20):
        loop = loop_of(resolved_draw(SCENARIO, draw, "model"))
        assert (open_loop_eigenvalues(loop.A) == 0).sum() == 2
        assert np.linalg.matrix_rank(loop.A) == 3
        lateral = np.sort(np.linalg.eigvals(loop.A[:2, :2]).real)
        others = np.sort(open_loop_eigenvalues(loop.A).real)[[0, -1]]
        np.testing.assert_allclose(others, [lateral[0], max(lateral[1], 0.0)], atol=1e-9)


def test_an_exact_model_sends_nothing_after_the_first_packet() -> None:
    found = measure_draw(SCENARIOS[EXACT_MODEL], 0)
    assert found.model.events == found.model.deliveries == 1
    assert found.model.gap_min_s == math.inf
    assert found.model.settled_1_s == pytest.approx(found.ideal_settled_1_s, abs=1e-6)
    assert found.zoh.events > 100
