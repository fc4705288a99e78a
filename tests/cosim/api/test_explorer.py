"""``noack.explore``: what follows from changed settings."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest

import noack
from cosim.interactive import draft_results


def test_results_are_those_of_the_library() -> None:
    scenario = noack.load("lane_following", {"horizon_s": 4.0})
    explorer = noack.explore(scenario)
    certificate = noack.certify(scenario).schedule
    assert certificate.constants is not None
    guarantee = explorer.certificate
    assert guarantee.verdict == "certified"
    np.testing.assert_array_equal(guarantee.e_c, certificate.controller_error(guarantee.t_s))
    assert explorer.ensemble is not None
    assert explorer.ensemble.draws == 200
    assert not explorer.margin.defined  # an event trigger has no longest time between events
    assert noack.explore("lane_periodic").margin.defined


def test_settings_change_the_results_and_wrong_ones_change_nothing() -> None:
    explorer = noack.explore("lane_following", {"network.mansd": 2})
    before = explorer.run
    assert explorer.run is before
    with pytest.raises(noack.NoackError, match=r"network\.mansd = -1"):
        explorer.set({"trigger.beta": 0.1, "network.mansd": -1})
    assert explorer.run is before
    assert explorer.scenario.trigger.beta == 0.5
    explorer.set({"trigger.beta": np.float64(0.1), "network.loss.probability": 0.0})
    assert explorer.numbers["lost"] == "0 (0 %)"
    assert explorer.scenario.network.mansd == 2
    explorer.set({"trigger.floor": 0.01})
    assert explorer.run.threshold is not None
    assert explorer.run.threshold.min() == 0.01
    explorer.set({"trigger.floor": None})
    assert explorer.run.threshold.min() < 0.01


def test_several_loops_are_refused() -> None:
    with pytest.raises(noack.NoackError, match=r"only one loop.*noack\.simulate"):
        noack.explore("shared_channel")


def test_a_saved_scenario_has_the_settings_and_the_comments(tmp_path: Path) -> None:
    explorer = noack.explore("lane_following", {"trigger.beta": 0.125})
    path = explorer.save(tmp_path / "mine.toml")
    assert noack.load(path).trigger.beta == 0.125
    assert "# M - 1: at most four consecutive losses" in path.read_text()
    table = noack.load("double_integrator").model_dump(mode="json", exclude_none=True)
    assert noack.load(noack.explore(table).save(path)).name == "double_integrator"


@pytest.fixture
def few_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    few = partial(draft_results.explore_ensemble, draws=20)
    monkeypatch.setattr(draft_results, "explore_ensemble", few)


def test_errors_are_said_to_decay_as_far_as_the_threshold_does() -> None:
    """With a floor of 0.02 ‖x‖ is 0.0065 after 60 s, and not e^(−0.3 t) = 1.5e-8."""
    explorer = noack.explore("double_integrator", {"trigger.floor": 0.0})
    assert explorer.certificate.reason.endswith("all errors decay at the rate 0.3 /s")
    assert explorer.certificate.reason.startswith("every loss pattern that the guarantee allows: ")
    explorer.set({"trigger.floor": 0.02})
    assert explorer.certificate.reason.endswith("down to what the threshold's floor leaves")


@pytest.mark.usefixtures("few_draws")
def test_a_loop_that_is_unstable_says_why_and_is_drawn() -> None:
    explorer = noack.explore("lane_following")
    A, B = explorer.scenario.plant.uncertainty_A, explorer.scenario.plant.uncertainty_B
    explorer.set({"plant.uncertainty_A": 15 * np.array(A), "plant.uncertainty_B": 15 * np.array(B)})
    assert "Zeno-like behaviour" in explorer.warning
    assert "a mode of the loop grows" in repr(explorer)
    assert explorer.run.x_norm[-1] > 10 * explorer.run.x_norm[0]
    assert explorer.ensemble is not None
    assert len(explorer.figure("V").axes) == len(explorer.figure(0).axes) == 4
    with pytest.raises(noack.NoackError, match="no such state; there are V, r, psi, Y_g"):
        explorer.figure("z")
    assert noack.explore("lane_vehicle", {"horizon_s": 1.0}).ensemble is None
    area = noack.explore("lane_following", {"trigger": {"policy": "send_on_area", "delta_s": 0.02}})
    assert "all errors stay bounded" in area.certificate.reason
    assert area.run.threshold is None
    assert area.figure().axes
