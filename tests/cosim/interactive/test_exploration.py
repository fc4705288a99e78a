"""What the lab page draws, compared with the simulators that it is computed from."""

import base64
import math
import re
from dataclasses import replace

import numpy as np
import pytest

import noack
from cosim.interactive import exploration
from cosim.interactive import scenario_guarantee as guarantee
from cosim.interactive.exploration_figure import ExploredRun, exploration_figure
from cosim.interactive.exploration_words import Reference, compare, verdict_of
from cosim.lab.page_parts import figure_part
from cosim.simulation.continuous import run_continuous
from cosim.studies.campaign.random_draws import drawn_scenario
from noack.core.errors import CallerError
from noack.scenario.resolution import resolve


def test_a_run_is_drawn_as_simulated_with_both_sides_of_each_event() -> None:
    scenario = noack.load("lane_following")
    run = run_continuous(resolve(scenario))
    explored = exploration.explore(scenario)
    assert explored.kind == exploration.EXACT
    assert (np.diff(explored.t_s) >= 0).all()
    assert explored.event_s.tolist() == run.event_s.tolist()
    assert explored.delivered.tolist() == run.delivered.tolist()
    for before, after in zip(run.before, run.after, strict=True):
        first = int(np.searchsorted(explored.t_s, before.t_s))
        np.testing.assert_array_equal(explored.x[first], before.x)
        assert explored.e_s_norm[first] == pytest.approx(np.linalg.norm(before.e_s))
        assert explored.e_c_norm[first + 1] == pytest.approx(np.linalg.norm(after.e_c))
        assert explored.e_s_norm[first + 1] == 0.0


def test_the_browser_is_sent_the_curves_and_legends_of_the_figure() -> None:
    known_scenario = noack.load("lane_following", {"network.initial_sync": "known_state"})
    explored_run = ExploredRun(exploration.explore(known_scenario), 0)._replace(
        guarantee=guarantee.certify(known_scenario)
    )
    figure = exploration_figure(explored_run)
    errors = figure.rows[1].panels[0].legend or ()
    assert "certified bound" in errors
    part = figure_part(figure)
    assert [entry["label"] for entry in part["panels"][1]["legend"]] == [*errors]
    numbers = np.frombuffer(base64.b64decode(part["numbers"]), "<f4")
    ends = np.cumsum(part["lengths"])
    item = next(item for item in part["panels"][2]["items"] if item["label"] == "‖x‖")
    sent = np.split(numbers, ends[:-1])[item["y"]]
    np.testing.assert_allclose(sent, explored_run.run.x_norm, rtol=1e-6)


def test_a_run_that_diverges_is_drawn_up_to_that_time_and_widens_the_band() -> None:
    scenario = noack.load("lane_following", {
        "mode": "zoh", "network.mansd": 20, "network.loss": {"model": "worst_case"},
        "trigger": {"policy": "periodic", "period_s": 1.0}, "horizon_s": 3000.0,
    })  # fmt: skip
    explored = exploration.explore(scenario)
    assert explored.diverged_at_s is not None
    assert explored.t_s[-1] <= 3000.0
    assert explored.numbers[0][1].startswith("diverged at")
    draws = exploration.explore_ensemble(scenario, draws=8)
    assert draws.diverged == 8
    assert not math.isfinite(draws.x_norm.high[-1])


def test_a_run_with_very_many_events_is_drawn_until_there() -> None:
    even = exploration.explore(noack.load("lane_following", {
        "trigger": {"policy": "periodic", "period_s": 0.002}
    }))  # fmt: skip
    assert even.cut_reason == "3000 events until 6 s; the rest is not drawn"
    assert even.t_s[-1] == even.event_s[-1] == pytest.approx(5.998)
    assert dict(even.numbers)["run"] == even.cut_reason
    accumulating = exploration.explore(noack.load("lane_following", {"trigger.alpha_per_s": 2.5}))
    assert accumulating.cut_reason.startswith("Zeno-like behaviour: inter-event times shrink to 0 (")
    assert accumulating.t_s[-1] < 20.0


def test_draws_that_are_left_out_are_not_among_those_that_are_counted() -> None:
    plant = noack.load("lane_following").plant
    box = {
        f"plant.{key}": (15 * np.array(getattr(plant, key))).tolist()
        for key in ("uncertainty_A", "uncertainty_B")
    }
    draws = exploration.explore_ensemble(noack.load("lane_following", box), draws=40)
    assert draws.failed > 0
    assert draws.numbers[0].label == f"transmissions in 90 % of {40 - draws.failed} draws"


def test_a_scenario_without_exact_simulation_is_refused_with_the_reason() -> None:
    scenario = noack.load("lane_vehicle")
    reason = exploration.why_not_exact(scenario)
    assert reason is not None
    with pytest.raises(CallerError, match="plant is not linear"):
        exploration.explore(scenario)
    assert exploration.why_not_exact(noack.load("lane_following")) is None


def test_a_run_with_a_delay_is_drawn_with_it() -> None:
    """In continuous time there is none: it was drawn as if its updates arrived at once."""
    delay = [{"kind": "delay", "delay_s": 0.5}]
    scenario = noack.load("lane_following", {"network.impairments": delay, "horizon_s": 6.0})
    run = exploration.explore_or_simulate(scenario)
    assert run.kind == exploration.SAMPLED
    simulated = noack.simulate(scenario).summary.loops[0]
    assert len(run.event_s) == simulated.events
    assert run.x_norm[-1] == pytest.approx(simulated.final_state_norm, rel=0.01)
    reason = exploration.why_not_exact(scenario)
    assert reason == "network.impairments: delay: the exact simulation has no delay"


@pytest.mark.parametrize("name", ["lane_following", "double_integrator"])
def test_trajectories_of_an_ensemble_are_those_of_the_exact_simulator(name: str) -> None:
    scenario = noack.load(name, {"network.initial_sync": "known_state"})
    draws, t_s = 3, np.linspace(0.0, scenario.horizon_s, 41)
    setting = exploration.setting_of(resolve(scenario))
    population = exploration.box_of(scenario).population(7, range(draws))
    _, events = exploration.run_with_events(setting, population)
    states = exploration.trajectories(setting, population, events, t_s)
    for draw in range(draws):
        exact = run_continuous(drawn_scenario(scenario, 7, draw)).at(t_s)
        expected = np.stack(exact[1:], axis=1)
        np.testing.assert_allclose(states[draw], expected, rtol=1e-6, atol=1e-8)


def test_a_certificate_has_bounds_over_time_or_a_reason() -> None:
    certified = guarantee.certify(noack.load("lane_weighted"))
    assert certified.verdict == guarantee.CERTIFIED
    assert np.isfinite(certified.e_c).all()
    assert dict(certified.rows)["loop gain (< 1)"]
    run = exploration.explore(noack.load("lane_weighted"))
    bound = np.interp(run.t_s, certified.t_s, certified.e_c)
    assert (run.e_c_norm <= bound * 1.01).all()
    assert "loop gain" in guarantee.certify(noack.load("reactor_petc")).reason
    no_guarantee = guarantee.certify(noack.load("lane_vehicle"))
    assert no_guarantee.verdict == guarantee.NOT_COVERED
    assert "not linear" in no_guarantee.reason
    assert np.isnan(no_guarantee.e_c).all()


def test_a_verdict_says_what_became_of_the_run_and_of_its_guarantee() -> None:
    run = exploration.explore(noack.load("lane_weighted"))
    certified = guarantee.certify(run.scenario)
    ending, kept, sent = (line.text for line in verdict_of(run, certified))
    assert ending.startswith("completed 20 s: stable, ‖x‖ fell from 3.0")
    share = float(kept.removeprefix("guarantee kept: ‖e_c‖ was at most ").split(" %")[0])
    bound = np.interp(run.t_s, certified.t_s, certified.e_c)
    assert share == pytest.approx(100 * np.max(run.e_c_norm / bound), rel=0.02, abs=0.06)
    assert sent.startswith(f"{len(run.event_s)} transmissions, ")
    low = replace(certified, e_c=1e-3 * certified.e_c)
    assert verdict_of(run, low)[1].text.startswith("guarantee broken since ")
    missing = guarantee.certify(noack.load("lane_vehicle"))
    verdict = verdict_of(run, missing)[1].text
    assert verdict == f"guarantee not checkable: {missing.reason}"


def test_a_loop_at_its_setpoint_breaks_no_guarantee() -> None:
    """The certificate bounds ‖x − x_r‖, which decays; ‖x‖ stays near ‖x_r‖ = 20.

    The verdict is that of the run's summary: stable.
    """
    run = exploration.explore_or_simulate(
        noack.load("lane_following", {"controller.setpoint": [0.0, 0.0, 0.0, 20.0]})
    )
    certified = guarantee.certify(run.scenario)
    assert run.x_norm[-1] == pytest.approx(20.0, rel=0.01)
    assert 20.0 < certified.x[-1] < 25.0
    ending, kept, _ = (line.text for line in verdict_of(run, certified))
    assert kept.startswith("guarantee kept: ")
    assert re.match(r"completed 20 s: stable, ‖x − x_r‖ rose from 17 to 17\.1, then fell to 0\.", ending)
    assert guarantee.warning(run, certified, None) == ""


def test_more_losses_than_assumed_break_a_guarantee_that_is_not_enforced() -> None:
    """Within the bound all the same: it was called kept, where a run's summary calls it broken."""
    scenario = noack.load("lane_following", {"network.enforce_mansd": False, "network.mansd": 3})
    run = exploration.explore(scenario)
    fourth = next(i for i in range(3, len(run.delivered)) if not run.delivered[i - 3 : i + 1].any())
    verdict = verdict_of(run, guarantee.certify(scenario))[1].text
    at_s = run.event_s[fourth]
    assert verdict == f"guarantee broken since {at_s:.3f} s: 4 consecutive updates lost, 3 allowed"


def test_a_comparison_ends_where_one_of_the_runs_does() -> None:
    short, whole = (
        exploration.explore(noack.load("lane_following", {"horizon_s": horizon_s}))
        for horizon_s in (5.0, 20.0)
    )
    comparison = compare(Reference("the whole", whole), short)
    assert comparison.title == "compared with the whole, until 5 s"
    assert comparison.settings == "Settings that differ: horizon_s 20.0 → 5.0."
    assert {row[3] for row in comparison.rows} <= {"the same", "nearly the same"}
