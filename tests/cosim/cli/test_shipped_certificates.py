"""``noack certify`` on every shipped scenario, from the command line, with searches that end early."""

import json
from pathlib import Path

import pytest

import noack
from netem.core.errors import ExitStatus
from noack.scenario.scenario import loop_names
from tests.helpers.command_line import invoke

FILES = (Path(__file__).parents[3] / "scenarios").glob("*.toml")
LIKE_OTHERS = {"lane_5g_arterial", "lane_5g_rural", "lane_weighted"}
"""Other numbers of scenarios that are tried."""
USUAL = {"unstable_pendulum", "dc_motor_load", "friction_servo", "model_predictive", "priority_channel"}
"""Scenarios of every ``make test``: a linear plant, a load, equations, no bounds, several loops."""
SCENARIOS = [
    pytest.param(name, marks=() if name in USUAL else pytest.mark.deep)
    for name in sorted({file.stem for file in FILES} - LIKE_OTHERS)
]


@pytest.mark.usefixtures("short_searches")
@pytest.mark.parametrize("name", SCENARIOS)
def test_a_shipped_scenario_has_bounds_or_reasons(name: str) -> None:
    first, *others = loop_names(noack.load(name))
    result = invoke("certify", name, "--json", *([f"--loop={first}"] if others else []))
    if result.exit_code == ExitStatus.CALLER:
        assert "pip install" in result.stderr
        return
    document = json.loads(result.stdout)
    proven = [each for each in document["certificates"] if each["proven"] is not None]
    assert proven or document["unproven"]
    assert all(each["reason"] for each in document["unproven"])
    is_stable = document["stability"] is not None and document["stability"]["verdict"] == "stable"
    assert result.exit_code == (0 if proven or is_stable else 1)
