"""``noack replay``: exit status, JSON, and one line for every mistake."""

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner, Result

from cosim.cli import app

PATH = Path(__file__).parents[4] / "scenarios" / "lane_following.toml"
SETTINGS = ("horizon_s=1", "plant.rate_hz=50", "controller.rate_hz=50")


def noack(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    settings = [word for setting in SETTINGS for word in ("--set", setting)]
    done = noack("simulate", PATH, "--runs", folder, *settings)
    assert done.exit_code == 0, done.output
    return folder


@pytest.fixture
def runs(simulated: Path, tmp_path: Path) -> Path:
    """An own folder of runs."""
    return Path(shutil.copytree(simulated, tmp_path / "runs", symlinks=True))


def rewrite(path: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    pq.write_table(change(pq.read_table(path)), path)


def nudged(table: pa.Table, column: str, row: int) -> pa.Table:
    values = table[column].to_numpy().copy()
    values[row] = math.nextafter(values[row], math.inf)
    return table.set_column(table.schema.get_field_index(column), column, pa.array(values))


def test_the_last_run_is_replayed(runs: Path) -> None:
    done = noack("replay", "--runs", runs)
    assert done.exit_code == 0
    assert done.stderr == ""
    assert "bit-exact: " in done.stdout
    document = json.loads(noack("replay", "--runs", runs, "--json").stdout)
    assert document["bit_exact"] is True
    assert document["complete"] is True
    assert document["first_difference"] is None
    assert document["inputs"] == sum(process["inputs"] for process in document["processes"])
    assert document["changed_since"] == []


def test_a_difference_is_reported_and_fails(runs: Path) -> None:
    rewrite(
        runs / "latest/record/controller_step.parquet", lambda table: nudged(table, "x_c_3", 11)
    )
    done = noack("replay", runs / "latest")
    assert done.exit_code == 1
    assert "controller_step row 11, x_c_3" in done.stdout
    assert "0x1." in done.stdout
    assert "not the machine of the run" not in done.stdout
    as_json = noack("replay", runs / "latest", "--json")
    assert as_json.exit_code == 1
    assert json.loads(as_json.stdout)["first_difference"]["column"] == "x_c_3"


def test_a_difference_on_another_machine_lists_what_changed(runs: Path) -> None:
    rewrite(runs / "latest/record/plant_step.parquet", lambda table: nudged(table, "x_1", 3))
    path = runs / "latest/environment.json"
    environment = json.loads(path.read_text())
    environment["packages"]["numpy"] = "1.0"
    path.write_text(json.dumps(environment))
    done = noack("replay", "--runs", runs)
    assert done.exit_code == 1
    assert "numpy was 1.0, is " in done.stdout
    document = json.loads(noack("replay", "--runs", runs, "--json").stdout)
    assert len(document["changed_since"]) == 1


def test_an_incomplete_record_is_exact_up_to_its_end(runs: Path) -> None:
    rewrite(
        runs / "latest/record/sensor_measurement.parquet",
        lambda table: pa.concat_tables([table.slice(0, 20), table.slice(22)]),
    )
    done = noack("replay", "--runs", runs)
    assert done.exit_code == 0
    assert "record incomplete: sensor: rows are missing from input 20 on" in done.stdout
    document = json.loads(noack("replay", "--runs", runs, "--json").stdout)
    assert document["bit_exact"] is True
    assert document["complete"] is False


def test_an_empty_record_fails(runs: Path) -> None:
    for path in (runs / "latest/record").glob("*.parquet"):
        rewrite(path, lambda table: table.slice(0, 0))
    done = noack("replay", "--runs", runs)
    assert done.exit_code == 1
    assert "nothing to compare" in done.stdout


def spoil(run_dir: Path, how: str) -> None:
    step = run_dir / "record/plant_step.parquet"
    if how == "no scenario":
        (run_dir / "scenario.toml").unlink()
    elif how == "no record":
        shutil.rmtree(run_dir / "record")
    elif how == "no table":
        step.unlink()
    elif how == "no Parquet":
        step.write_bytes(b"PAR1 no more")
    elif how == "no column":
        rewrite(step, lambda table: table.drop_columns(["x_4"]))


@pytest.mark.parametrize("how", ["no scenario", "no record", "no table", "no Parquet", "no column"])
def test_an_invalid_run_directory_gives_one_line(runs: Path, how: str) -> None:
    spoil(runs / "latest", how)
    done = noack("replay", runs / "latest")
    assert done.exit_code == 2
    assert done.stdout == ""
    assert done.stderr.startswith("noack: ")
    assert done.stderr.count("\n") == 1


def test_a_missing_run_gives_one_line(tmp_path: Path) -> None:
    for arguments in (("--runs", tmp_path / "none"), (tmp_path,)):
        done = noack("replay", *arguments)
        assert done.exit_code == 2
        assert done.stderr.count("\n") == 1
