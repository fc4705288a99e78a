"""certify, margin and the verdict of a run give the same answer about a scenario."""

from pathlib import Path

import pytest

import noack
from cosim.cli.destabilising_run import GROWN, until_it_shows
from cosim.cli.options import load_scenario
from netem.output.result_tables import Tone
from tests.helpers.command_line import invoke

pytestmark = pytest.mark.usefixtures("nothing_was_found_before")


@pytest.mark.parametrize(
    ("name", "is_certified"),
    [
        ("lane_following", True),
        ("cart_pole", False),
        ("model_predictive", False),
        ("lane_python_trigger", False),
    ],
)
def test_the_answer_of_certify_is_that_of_the_run(name: str, is_certified: bool) -> None:
    answer = noack.certify(name, search=False).answer
    assert answer.is_certified == is_certified
    line = noack.simulate(noack.load(name, {"horizon_s": 1.0})).verdict[-2]
    assert line.tone == (Tone.GOOD if is_certified else Tone.DOUBTFUL)
    if not is_certified:
        assert line.text == f"guarantee not checkable: {answer.text}"


@pytest.mark.parametrize(("period_s", "losses"), [(0.1, 0), (0.5, 4)])
def test_the_answer_of_certify_is_that_of_margin(period_s: float, losses: int) -> None:
    """margin said of the first only that every pattern is stable."""
    scenario = noack.load("lane_periodic", {"trigger.period_s": period_s, "network.mansd": losses})
    answer = noack.certify(scenario, search=False).answer
    assert answer.is_certified == (losses == 0)
    margin = noack.margin(scenario, most_mansd=0, period=False)
    assert margin.certificate == answer
    assert str(margin).splitlines()[-1] == (
        f"noack certify --no-search, for at most {losses} lost in a row: {answer.text}"
    )


@pytest.mark.deep
def test_a_played_pattern_is_long_enough_to_show_its_growth(tmp_path: Path) -> None:
    margin = noack.margin("lane_periodic", most_mansd=6, period=False)
    assert margin.destabilised is not None
    words = [word for setting in margin.destabilised.settings for word in ("--set", setting)]
    short = invoke("simulate", "lane_periodic", "--no-report", "--runs", tmp_path, *words)
    assert "stable, ‖x‖ fell from" in short.stdout  # 20 s show the decay of the other modes only
    played = until_it_shows(load_scenario("lane_periodic", margin.destabilised.settings))
    run = noack.simulate(played.scenario)
    (loop,) = run.summary.loops
    assert loop.initial_state_norm is not None
    assert loop.final_state_norm is not None
    assert loop.final_state_norm >= GROWN * loop.initial_state_norm
    assert "‖x‖ grew from" in run.verdict[1].text
    outputs = run.verdict[0]
    assert (outputs.text.partition(" was at most ")[0], outputs.tone) == ("lateral offset", Tone.DOUBTFUL)
    expected = f"in {played.scenario.horizon_s:g} s ‖x‖ goes from 3.04 to {loop.final_state_norm:.3g}"
    assert played.expected == f"expected, as in virtual time: {expected}"
