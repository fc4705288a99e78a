"""Measures of a draw, against closed forms and against the simulator's own summary."""

import math

import numpy as np
import pytest
from scipy.linalg import expm

from cosim.simulation.continuous import run_continuous, summary
from cosim.studies.paper.paper_campaign import (
    BASE,
    EXACT_MODEL,
    MODES,
    Draw,
    certified,
    load_campaign,
    measure_draw,
    open_loop_eigenvalues,
    printed,
    resolved_draw,
)
from noack.config.resolution import loop_of

_, SCENARIOS = load_campaign()
SCENARIO = SCENARIOS[BASE]
DRAW = 3


@pytest.fixture(scope="module")
def found() -> Draw:
    return measure_draw(SCENARIO, DRAW)


def test_the_loop_without_a_network_settles_when_its_matrix_exponential_does(found: Draw) -> None:
    loop = loop_of(resolved_draw(SCENARIO, DRAW, "model"))
    closed = loop.A + loop.B @ loop.K
    for share, settled_s in ((0.05, found.ideal_settled_5_s), (0.01, found.ideal_settled_1_s)):
        times_s = np.linspace(settled_s, 40.0, 200)
        norms = [np.linalg.norm(expm(closed * t_s) @ loop.x0) for t_s in times_s]
        assert norms[0] == pytest.approx(share * found.start_norm, rel=1e-4)
        assert max(norms[1:]) < norms[0]


def test_a_loop_that_does_not_settle_within_the_horizon_never_settles() -> None:
    short = measure_draw(SCENARIO.model_copy(update={"horizon_s": 1.0}), DRAW)
    assert short.model.settled_5_s == short.zoh.settled_1_s == short.ideal_settled_5_s == math.inf


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
