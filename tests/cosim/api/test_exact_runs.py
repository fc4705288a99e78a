"""``noack.simulate_exactly``: its curves are those of the exact simulation, at and between events."""

import numpy as np
import pytest

import noack
from cosim.simulation.continuous import run_continuous
from noack.scenario.resolution import resolve


def curves_of(run: noack.ExactRun, name: str) -> list[noack.Curve]:
    return [curve for curve in run.curves() if curve.name == name]


def test_curves_have_the_states_of_the_exact_simulation_and_both_sides_of_an_event() -> None:
    scenario = noack.load("lane_following", {"horizon_s": 4.0})
    run, exact = noack.simulate_exactly(scenario), run_continuous(resolve(scenario))
    np.testing.assert_array_equal(run.event_s, exact.event_s)
    t_s = curves_of(run, "x plant")[0].t_s
    x = np.column_stack([curve.values for curve in curves_of(run, "x plant")])
    even = ~np.isin(t_s, run.event_s)
    np.testing.assert_allclose(x[even], exact.at(t_s[even]).x, rtol=1e-12)
    (e_s,), (threshold,) = curves_of(run, "‖e_s‖ sensor"), curves_of(run, "threshold")
    for event_s in run.event_s[1:]:  # event 0 is the first packet
        before, after = np.flatnonzero(t_s == event_s)
        assert e_s.values[before] == pytest.approx(threshold.values[before], rel=1e-9)
        assert e_s.values[after] == 0.0
    points = [len(curve.t_s) for name in ("delivered", "lost") for curve in curves_of(run, name)]
    assert points == [run.summary.deliveries, run.summary.drops]
    assert [line.text.split()[0] for line in run.verdict] == ["completed", str(run.summary.events)]


def test_the_controller_has_no_state_before_its_first_update() -> None:
    scenario = noack.load("lane_following", {"horizon_s": 4.0})
    assert scenario.network.initial_sync == "first_packet"
    x_c = curves_of(noack.simulate_exactly(scenario), "x_c controller")[0]
    assert np.isnan(x_c.values[0])
    assert np.isfinite(x_c.values[1:]).all()
    known = noack.with_settings(scenario, {"network.initial_sync": "known_state"})
    assert np.isfinite(curves_of(noack.simulate_exactly(known), "x_c controller")[0].values).all()
