"""``noack replay``: the last run, a difference, and an empty record."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from cosim.live.finalize import finalize
from cosim.simulation.virtual_time import simulate_run
from noack.scenario.scenario_file import load
from tests.helpers.command_line import invoke

LANE = Path(__file__).parents[4] / "scenarios" / "lane_following.toml"


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    scenario = load(LANE, ["horizon_s=1", "plant.rate_hz=50", "controller.rate_hz=50"])
    finalize(simulate_run(scenario, folder), report=False, view=False)
    return folder


@pytest.fixture
def runs(simulated: Path, tmp_path: Path) -> Path:
    """An own folder of runs."""
    return Path(shutil.copytree(simulated, tmp_path / "runs", symlinks=True))


def rewrite(runs: Path, table: str, change: Callable[[pa.Table], pa.Table]) -> None:
    path = runs / "latest" / "record" / f"{table}.parquet"
    pq.write_table(change(pq.read_table(path)), path)


def alter(runs: Path, table: str, column: str, by: float) -> None:
    """Add a ramp to a column."""

    def changed(rows: pa.Table) -> pa.Table:
        values = rows[column].to_numpy() + np.linspace(0, by, len(rows))
        return rows.set_column(rows.schema.get_field_index(column), column, pa.array(values))

    rewrite(runs, table, changed)


def test_replay_takes_the_last_run(simulated: Path) -> None:
    result = invoke("replay", "--runs", simulated)
    assert (result.exit_code, result.stderr) == (0, "")
    assert "bit-exact: " in result.stdout
    document = json.loads(invoke("replay", "--runs", simulated, "--json").stdout)
    assert (document["bit_exact"], document["complete"]) == (True, True)
    assert document["first_difference"] is None
    assert document["inputs"] == sum(process["inputs"] for process in document["processes"])
    assert document["changed_since"] == []


def test_a_difference_is_reported_and_fails(runs: Path) -> None:
    alter(runs, "controller_step", "x_c_3", 1e-9)
    path = runs / "latest/environment.json"
    environment = json.loads(path.read_text())
    environment["packages"]["numpy"] = "1.0"
    path.write_text(json.dumps(environment))
    result = invoke("replay", "--runs", runs)
    assert result.exit_code == 1
    assert "controller_step row 1, x_c_3" in result.stdout
    assert "0x1." in result.stdout
    assert "numpy was 1.0, is " in result.stdout
    result = invoke("replay", "--runs", runs, "--json")
    document = json.loads(result.stdout)
    assert (result.exit_code, document["first_difference"]["column"]) == (1, "x_c_3")
    assert len(document["changed_since"]) == 1
