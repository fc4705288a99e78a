"""``noack replay`` and ``noack fidelity``: exit status, JSON, and one line for every error."""

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray
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


def alter(
    runs: Path, table: str, column: str, change: Callable[[NDArray[np.float64]], None]
) -> None:
    """Change the values of a column in place."""

    def changed(rows: pa.Table) -> pa.Table:
        values = rows[column].to_numpy().copy()
        change(values)
        return rows.set_column(rows.schema.get_field_index(column), column, pa.array(values))

    rewrite(runs, table, changed)


def nudge(row: int) -> Callable[[NDArray[np.float64]], None]:
    def change(values: NDArray[np.float64]) -> None:
        values[row] = math.nextafter(values[row], math.inf)

    return change


def test_the_last_run_is_replayed(simulated: Path) -> None:
    done = noack("replay", "--runs", simulated)
    assert (done.exit_code, done.stderr) == (0, "")
    assert "bit-exact: " in done.stdout
    document = json.loads(noack("replay", "--runs", simulated, "--json").stdout)
    assert document["bit_exact"] is True
    assert document["complete"] is True
    assert document["first_difference"] is None
    assert document["inputs"] == sum(process["inputs"] for process in document["processes"])
    assert document["changed_since"] == []


def test_a_difference_is_reported_and_fails(runs: Path) -> None:
    alter(runs, "controller_step", "x_c_3", nudge(11))
    done = noack("replay", runs / "latest")
    assert done.exit_code == 1
    assert "controller_step row 11, x_c_3" in done.stdout
    assert "0x1." in done.stdout
    assert "not the machine of the run" not in done.stdout
    path = runs / "latest/environment.json"
    environment = json.loads(path.read_text())
    environment["packages"]["numpy"] = "1.0"
    path.write_text(json.dumps(environment))
    assert "numpy was 1.0, is " in noack("replay", "--runs", runs).stdout
    done = noack("replay", "--runs", runs, "--json")
    assert done.exit_code == 1
    document = json.loads(done.stdout)
    assert document["first_difference"]["column"] == "x_c_3"
    assert len(document["changed_since"]) == 1


def test_an_empty_record_fails(runs: Path) -> None:
    for path in (runs / "latest/record").glob("*.parquet"):
        rewrite(runs, path.stem, lambda rows: rows.slice(0, 0))
    done = noack("replay", "--runs", runs)
    assert done.exit_code == 1
    assert "nothing to compare" in done.stdout


def test_the_last_run_is_compared_with_the_ideal_loop(simulated: Path) -> None:
    done = noack("fidelity", "--runs", simulated)
    assert (done.exit_code, done.stderr) == (0, ""), done.output
    assert "held actuation" in done.stdout
    document = json.loads(noack("fidelity", simulated / "latest", "--json").stdout)
    assert document["explained"] is True
    names = [stage["name"] for stage in document["stages"]]
    assert names == ["sampling", "delay", "held actuation", "residual"]


def test_an_unexplained_difference_fails(runs: Path) -> None:
    def move(values: NDArray[np.float64]) -> None:
        values += np.linspace(0, 1, len(values))

    alter(runs, "plant_step", "x_4", move)
    done = noack("fidelity", runs / "latest")
    assert done.exit_code == 1
    assert "too large" in done.stdout
    assert noack("fidelity", runs / "latest", "--json").exit_code == 1


def damage(run_dir: Path, how: str) -> None:
    step = run_dir / "record/plant_step.parquet"
    if how == "no scenario":
        (run_dir / "scenario.toml").unlink()
    elif how == "no record":
        shutil.rmtree(run_dir / "record")
    elif how == "no table":
        step.unlink()
    elif how == "no Parquet":
        step.write_bytes(b"PAR1 no more")
    else:
        rewrite(run_dir.parent, "plant_step", lambda rows: rows.drop_columns(["x_4"]))


@pytest.mark.parametrize("how", ["no scenario", "no record", "no table", "no Parquet", "no column"])
def test_an_invalid_run_directory_gives_one_line(runs: Path, how: str) -> None:
    damage(runs / "latest", how)
    for command in COMMANDS:
        done = noack(command, runs / "latest")
        assert (done.exit_code, done.stdout) == (2, "")
        assert done.stderr.startswith("noack: ")
        assert done.stderr.count("\n") == 1


def test_a_missing_run_gives_one_line(tmp_path: Path) -> None:
    for command in COMMANDS:
        for arguments in (("--runs", tmp_path / "none"), (tmp_path,)):
            done = noack(command, *arguments)
            assert done.exit_code == 2
            assert done.stderr.count("\n") == 1
