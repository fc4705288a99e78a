"""``noack replay`` and ``noack fidelity``: exit status, JSON, and one line for every error."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner, Result

from cosim.cli import app
from cosim.live.finalize import finalize
from cosim.live.simulated_run import simulate_run
from noack.scenario.scenario_file import load

LANE = Path(__file__).parents[3] / "scenarios" / "lane_following.toml"
COMMANDS = ("replay", "fidelity")


def noack(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


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


def test_the_last_run_is_replayed_and_compared_with_the_ideal_loop(simulated: Path) -> None:
    for command, text in (("replay", "bit-exact: "), ("fidelity", "held actuation")):
        done = noack(command, "--runs", simulated)
        assert (done.exit_code, done.stderr) == (0, "")
        assert text in done.stdout
    document = json.loads(noack("replay", "--runs", simulated, "--json").stdout)
    assert (document["bit_exact"], document["complete"]) == (True, True)
    assert document["first_difference"] is None
    assert document["inputs"] == sum(process["inputs"] for process in document["processes"])
    assert document["changed_since"] == []
    document = json.loads(noack("fidelity", simulated / "latest", "--json").stdout)
    assert document["explained"] is True
    names = [stage["name"] for stage in document["stages"]]
    assert names == ["sampling", "delay", "held actuation", "residual"]


def test_a_difference_is_reported_and_fails(runs: Path) -> None:
    alter(runs, "controller_step", "x_c_3", 1e-9)
    path = runs / "latest/environment.json"
    environment = json.loads(path.read_text())
    environment["packages"]["numpy"] = "1.0"
    path.write_text(json.dumps(environment))
    done = noack("replay", "--runs", runs)
    assert done.exit_code == 1
    assert "controller_step row 1, x_c_3" in done.stdout
    assert "0x1." in done.stdout
    assert "numpy was 1.0, is " in done.stdout
    done = noack("replay", "--runs", runs, "--json")
    document = json.loads(done.stdout)
    assert (done.exit_code, document["first_difference"]["column"]) == (1, "x_c_3")
    assert len(document["changed_since"]) == 1


def test_an_empty_record_and_an_unexplained_difference_fail(runs: Path) -> None:
    alter(runs, "plant_step", "x_4", 1.0)
    done = noack("fidelity", runs / "latest")
    assert done.exit_code == noack("fidelity", runs / "latest", "--json").exit_code == 1
    assert "too large" in done.stdout
    for path in (runs / "latest/record").glob("*.parquet"):
        rewrite(runs, path.stem, lambda rows: rows.slice(0, 0))
    done = noack("replay", "--runs", runs)
    assert done.exit_code == 1
    assert "nothing to compare" in done.stdout


STEPS = "record/plant_step.parquet"
DAMAGE: dict[str, Callable[[Path], object]] = {
    "no scenario": lambda runs: (runs / "latest/scenario.toml").unlink(),
    "no record": lambda runs: shutil.rmtree(runs / "latest/record"),
    "no table": lambda runs: (runs / "latest" / STEPS).unlink(),
    "no Parquet": lambda runs: (runs / "latest" / STEPS).write_bytes(b"PAR1 no more"),
    "no column": lambda runs: rewrite(runs, "plant_step", lambda rows: rows.drop_columns(["x_4"])),
    "no run": lambda runs: (runs / "latest").unlink(),
}


@pytest.mark.parametrize("how", DAMAGE)
def test_an_invalid_run_directory_gives_one_line(runs: Path, how: str) -> None:
    DAMAGE[how](runs)
    for command in COMMANDS:
        done = noack(command, "--runs", runs)
        assert (done.exit_code, done.stdout) == (2, "")
        assert done.stderr.startswith("noack: ")
        assert done.stderr.count("\n") == 1
