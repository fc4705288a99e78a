"""The shipped scenarios: each runs on each user interface; ``noack scenarios`` copies them."""

import json
import tomllib
from contextlib import suppress
from pathlib import Path

import pytest

import noack
from noack.scenario.resolution import resolved_loops
from noack.scenario.scenario_file import load
from tests.helpers.command_line import invoke

ROOT = Path(__file__).parents[3]
SCENARIOS = sorted(file.stem for file in (ROOT / "scenarios").glob("*.toml"))
CAMPAIGNS = sorted(file.stem for file in (ROOT / "campaigns").glob("*.toml"))
LANES = ("lane_following", "lane_acknowledged", "lane_actuation_loss", "lane_crosswind")
"""Of the scenarios of the lane, those whose recordings and summaries have parts of their own."""


@pytest.mark.parametrize("name", SCENARIOS)
def test_a_shipped_scenario_runs_from_the_command_line_and_in_the_library(name: str, tmp_path: Path) -> None:
    scenario = noack.load(name, {"horizon_s": 0.2})
    try:
        resolved_loops(scenario)
    except noack.NoackError as error:
        if "pip install" not in str(error):
            raise
        pytest.skip(str(error))
    checked = invoke("check", name)
    assert checked.exit_code == 0, checked.output
    if scenario.loops:  # tests/cosim/test_scenarios.py and simulation/test_simulated_run.py run them
        return
    with suppress(noack.NoackError):  # the exact simulation does not cover every scenario
        assert noack.simulate_exactly(scenario).summary.reached_s == pytest.approx(0.2)
    if name.startswith("lane_") and name not in LANES:  # tests/cosim/test_scenarios.py runs it whole
        return
    short = ["simulate", name, "--set", "horizon_s=0.2", "--runs", str(tmp_path), "--no-report"]
    simulated = invoke(*short, "--json")
    assert simulated.exit_code == 0, simulated.output
    assert json.loads(simulated.stdout)["exit"]["status"] == 0


def test_all_shipped_scenarios_are_listed_with_their_description() -> None:
    document = json.loads(invoke("scenarios", "--json").stdout)
    assert [entry["name"] for entry in document["scenarios"]] == SCENARIOS
    assert [entry["name"] for entry in document["campaigns"]] == CAMPAIGNS
    result = invoke("scenarios")
    assert result.exit_code == 0
    lines = [" ".join(line.split()) for line in result.stdout.splitlines()]  # one line each
    for folder, names in (("scenarios", SCENARIOS), ("campaigns", CAMPAIGNS)):
        for name in names:
            content = tomllib.loads((ROOT / folder / f"{name}.toml").read_text("utf-8"))
            assert f"{name} {content['description']}" in lines


@pytest.mark.parametrize("name", SCENARIOS)
def test_a_printed_scenario_loads_from_any_folder(name: str, tmp_path: Path) -> None:
    result = invoke("scenarios", name)
    assert result.exit_code == 0
    copy = tmp_path / "mine.toml"
    copy.write_text(result.stdout, encoding="utf-8")
    assert load(copy) == load(ROOT / "scenarios" / f"{name}.toml")
    assert "schema" not in result.stdout  # which is in another folder
