"""``noack check --resolved``: a scenario file of the same run, in numbers only."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import simulate
from noack.core.errors import CallerError
from noack.protocol.record_tables import CONTROLLER_STEP, NETEM_PACKET, PLANT_STEP, SENSOR_MEASUREMENT
from noack.scenario.resolution import resolve, resolved_loops
from noack.scenario.scenario import Scenario, loops_of
from noack.scenario.scenario_file import load
from noack.theory.certificates.conditions import allowed_conditions
from tests.helpers.command_line import invoke

SCENARIOS = Path(__file__).parents[3] / "scenarios"
NAMES = sorted(file.stem for file in SCENARIOS.glob("*.toml"))


def printed(*arguments: str) -> str:
    result = invoke("check", *arguments, "--resolved")
    assert result.exit_code == 0, result.output
    return result.stdout


def short_run(scenario: Scenario) -> RunRecord:
    return simulate(resolve(scenario).model_copy(update={"horizon_s": 0.3, "changes": ()}))


@pytest.mark.parametrize("name", NAMES)
def test_output_is_a_scenario_of_the_same_run(name: str, tmp_path: Path) -> None:
    loop = loops_of(load(SCENARIOS / f"{name}.toml"))[0]
    try:
        resolved_loops(loop)
    except CallerError as error:
        if "pip install" not in str(error):
            raise
        pytest.skip(str(error))
    text = printed(name, *(() if loop.name == name else ("--loop", loop.name)))
    (file := tmp_path / "resolved.toml").write_text(text)
    assert printed(str(file)) == text
    again = load(file)
    assert allowed_conditions(resolve(again)) == allowed_conditions(resolve(loop))
    first, second = short_run(loop), short_run(again)
    for table in (PLANT_STEP, SENSOR_MEASUREMENT, NETEM_PACKET, CONTROLLER_STEP):
        np.testing.assert_array_equal(first[table], second[table])


def test_output_has_numbers_for_times_that_follow_from_other_keys() -> None:
    delayed = 'network.impairments=[{kind="delay", delay_s=0.02, jitter_s=0.003}]'
    content = tomllib.loads(printed("lane_following", "--set", delayed))
    assert content["certificate"]["network_delay_s"] == pytest.approx(0.023)
    assert content["plant"]["watchdog"]["timeout_s"] == pytest.approx(0.1)
    assert content["plant"]["draw"] == "given"


def test_delay_in_a_queue_stays_unknown() -> None:
    queue = 'network.impairments=[{kind="rate", rate_bps=1000000}]'
    assert "network_delay_s" not in tomllib.loads(printed("lane_following", "--set", queue))["certificate"]


def test_one_of_several_loops_is_named() -> None:
    result = invoke("check", "shared_channel", "--resolved")
    assert result.exit_code != 0
    assert "--loop NAME" in result.output
