"""``noack check --resolved``: a scenario file of the same run, in numbers only."""

from pathlib import Path

import numpy as np
import pytest

from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import simulate
from netem.core.errors import CallerError
from netem.core.packet_rows import NETEM_PACKET
from noack.protocol.record_tables import CONTROLLER_STEP, PLANT_STEP, SENSOR_MEASUREMENT
from noack.scenario.resolution import resolve, resolved_loops
from noack.scenario.scenario import Scenario, loops_of
from noack.scenario.scenario_file import load
from noack.theory.certificates.conditions import allowed_conditions
from noack.theory.certificates.normal_values import normal_limit
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
    if normal_limit(resolve(loop)) is not None:  # printed as the bounded values of certificates
        assert normal_limit(resolve(again)) is None
        return
    first, second = short_run(loop), short_run(again)
    for table in (PLANT_STEP, SENSOR_MEASUREMENT, NETEM_PACKET, CONTROLLER_STEP):
        np.testing.assert_array_equal(first[table], second[table])
