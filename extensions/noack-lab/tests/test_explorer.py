"""``noack_lab.explore``, the results that it and the page show, and the chart of the page."""

import json
from pathlib import Path

import numpy as np
import pytest

import noack
import noack_lab
from noack_lab import results
from noack_lab.chart import Drawn, chart_options


def test_results_are_those_of_the_library() -> None:
    scenario = noack.load("lane_following", {"horizon_s": 4.0})
    explorer = noack_lab.explore(scenario)
    run = noack.simulate_exactly(scenario)
    np.testing.assert_array_equal(explorer.run.transmissions, run.delivered)
    assert dict(explorer.run.facts)["longest loss burst"] == str(run.summary.longest_loss_burst)
    certificate = noack.certify(scenario, search=False).schedule
    bound = explorer.certificate.curves[0]
    np.testing.assert_array_equal(bound.values, certificate.controller_error(bound.t_s))
    assert explorer.certificate.line.text.startswith("certified: the scenario's plant")
    assert "longest time" in explorer.margin  # an event trigger has none


def test_settings_change_the_results_and_wrong_ones_change_nothing() -> None:
    explorer = noack_lab.explore("lane_following", {"network.mansd": 2})
    before = explorer.run
    with pytest.raises(noack.NoackError, match=r"network\.mansd = -1"):
        explorer.set({"trigger.beta": 0.1, "network.mansd": -1})
    assert explorer.run is before
    explorer.set({"trigger.beta": np.float64(0.1), "network.loss.probability": 0.0})
    assert dict(explorer.run.facts)["lost"] == "0 (0 %)"
    assert (explorer.scenario.network.mansd, explorer.scenario.trigger.beta) == (2, 0.1)


def test_a_saved_scenario_has_the_settings_and_the_comments(tmp_path: Path) -> None:
    path = noack_lab.explore("lane_following", {"trigger.beta": 0.125}).save(tmp_path / "mine.toml")
    assert noack.load(path).trigger.beta == 0.125
    assert "# at most four packets are lost in a row" in path.read_text()


def test_several_loops_are_refused() -> None:
    with pytest.raises(noack.NoackError, match=r"only one loop.*noack\.simulate"):
        noack_lab.explore("shared_channel")


def test_a_loop_that_is_unstable_says_why_and_is_drawn() -> None:
    explorer = noack_lab.explore("lane_following", {"horizon_s": 3.0})
    A, B = explorer.scenario.plant.uncertainty_A, explorer.scenario.plant.uncertainty_B
    explorer.set({"plant.uncertainty_A": 15 * np.array(A), "plant.uncertainty_B": 15 * np.array(B)})
    assert "the loop does not decay without losses" in repr(explorer)
    norm = explorer.run.values("norm of the state", "‖x‖ plant")
    assert norm[-1] > norm[0]
    assert len(explorer.figure("V").axes) == 6


def test_a_plant_that_is_not_linear_is_simulated_in_virtual_time_with_the_reason() -> None:
    run = noack_lab.explore("dc_motor", {"horizon_s": 0.2}).run
    assert run.kind == results.SIMULATED
    assert "not given by matrices" in run.note
    assert run.note.startswith("in virtual time; an exact run is not possible: ")
    assert run.verdict[0].text.startswith("shaft_angle was ")


@pytest.mark.deep
def test_distances_from_a_reference_are_drawn_with_the_bounds_about_it() -> None:
    explorer = noack_lab.explore("servo_reference", {"horizon_s": 6.0})
    bounds = {curve.panel: curve for curve in explorer.certificate.curves}
    for name in ("‖x − x_r‖ plant", "angle"):
        (curve,) = (curve for curve in explorer.run.curves if curve.name == name)
        bound = bounds[curve.panel]
        assert np.all(curve.values <= np.interp(curve.t_s, bound.t_s, bound.values) * 1.001)
        assert curve.values[-1] < 0.02  # the angle itself is at 1.5 then
    facts = dict(explorer.certificate.facts)
    assert facts["angle"].startswith("stays within 0.15 rad of its reference from ")
    titles = [title["text"] for title in chart_options(Drawn(explorer.run, ""))["title"]]
    assert "|angle − r| [rad] (logarithmic)" in titles


def test_a_recorded_run_has_its_loops_and_its_bounds(tmp_path: Path) -> None:
    run = noack.simulate(noack.load("lane_following", {"horizon_s": 2.0}), runs=tmp_path)
    shown = results.recorded_run(run.directory, None)
    assert shown.loops == tuple(run.loops)
    assert [line.text for line in shown.verdict] == [line.text for line in run.verdict]
    assert any("certified" in curve.name for curve in shown.curves)
    assert results.replay(run.directory).startswith("replay: bit-exact")


def test_the_chart_has_a_panel_for_each_quantity_and_is_json() -> None:
    explorer = noack_lab.explore("lane_following", {"horizon_s": 4.0})
    run, before = explorer.run, noack_lab.explore("lane_following", {"horizon_s": 2.0}).run
    options = chart_options(Drawn(run, "psi", explorer.certificate.curves, before))
    titles = [title["text"].split(" (")[0] for title in options["title"]]
    assert titles == [
        "psi [rad]", "|lateral offset| [m]", "|heading| [rad]", "error norms", "norm of the state",
        "inter-event time [s]",
    ]  # fmt: skip
    assert json.loads(json.dumps(options, allow_nan=False))["xAxis"][0]["max"] == 4.0
    series = {(part["name"], part["yAxisIndex"]): part for part in options["series"]}
    drawn = np.array(series["‖x‖ plant", 4]["data"], float)
    (curve,) = [curve for curve in run.curves if curve.name == "‖x‖ plant"]
    np.testing.assert_allclose(drawn, np.column_stack([curve.t_s, curve.values]), rtol=1e-5)
    assert {("for comparison", 0), ("for comparison", 4), ("certified bound", 3)} <= {*series}
    assert options["yAxis"][3]["type"] == "log"
    reached = [value for _, value in series["‖e_s‖ sensor", 3]["data"] if value is not None]
    assert min(reached) > 0  # it is 0 after a reset, which is a gap
