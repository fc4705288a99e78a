"""A simulated run gives a run directory that all readers of run directories accept."""

import json
from pathlib import Path

import pytest
import rerun.chunk
from typer.testing import CliRunner, Result

from cosim.cli import app
from cosim.live.simulated_run import simulate_run
from cosim.output.viewer import blueprint
from cosim.record.run_directory import write_environment
from cosim.record.run_record import RecordedRun, load_record
from cosim.simulation.virtual_time import Progress, simulate
from noack.core.errors import CallerError, MachineError
from noack.protocol.record_tables import tables
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load

PATH = Path(__file__).parents[3] / "scenarios" / "double_integrator.toml"
SHORT = ("horizon_s=2", "plant.rate_hz=100", "controller.rate_hz=100", "trigger.beta=0.05")


def noack(*arguments: str) -> Result:
    return CliRunner().invoke(app, arguments)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run without a report, of which one was written later."""
    folder = tmp_path_factory.mktemp("runs")
    settings = [word for setting in SHORT for word in ("--set", setting)]
    words = ("simulate", str(PATH), "--runs", str(folder), "--json", "--no-report")
    done = noack(*words, *settings)
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout) == json.loads((folder / "latest/summary.json").read_text())
    assert not (folder / "latest/report.html").exists()
    assert noack("report", "--runs", str(folder)).exit_code == 0
    return folder


def test_a_simulated_run_has_the_files_of_a_live_run(runs: Path) -> None:
    run_dir = runs / "latest"
    assert {path.name for path in run_dir.iterdir()} == {
        "scenario.toml", "environment.json", "record", "recording.rrd", "reports.json",
        "summary.json", "report.html", "ending.json", "logs", ".lock",
    }  # fmt: skip
    assert {path.name for path in (run_dir / "record").iterdir()} == {
        *(f"{table}.parquet" for table in tables(2, 1)),
        "notices.jsonl",
    }
    reader = rerun.chunk.RrdReader(run_dir / "recording.rrd")
    (store,) = reader.recordings()
    paths = {chunk.entity_path.removeprefix("/") for chunk in reader.stream(store=store)}
    assert {blueprint.EVENT, blueprint.INPUT} <= paths
    assert not [path for path in paths if path.startswith("lateness")]


def test_the_record_on_disk_equals_the_simulators(runs: Path) -> None:
    again, loaded = simulate(resolve(load(PATH, SHORT))), load_record(runs / "latest")
    assert all(again[table].tobytes() == loaded[table].tobytes() for table in again.tables)
    assert loaded.scenario == again.scenario
    assert loaded.kind == again.kind == "simulated"
    assert loaded.reports == again.reports
    assert loaded.notices == again.notices


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(28, "No space left on device")])
def test_an_interrupted_simulation_leaves_no_run_directory(
    tmp_path: Path, error: BaseException, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(scenario: Scenario, progress: Progress | None) -> RecordedRun:
        raise error

    monkeypatch.setattr("cosim.live.simulated_run.simulate_loops", broken)
    expected = MachineError if isinstance(error, OSError) else type(error)
    with pytest.raises(expected):
        simulate_run(load(PATH, SHORT), tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_run_directory_without_a_kind_is_a_live_run(runs: Path, tmp_path: Path) -> None:
    for path in (runs / "latest").iterdir():
        (tmp_path / path.name).symlink_to(path)
    (tmp_path / "environment.json").unlink()
    assert load_record(tmp_path).kind == "live"
    write_environment(tmp_path, "simulated")
    assert load_record(tmp_path).kind == "simulated"


def test_a_recorded_scenario_may_exceed_the_size_limit_of_scenarios(tmp_path: Path) -> None:
    (tmp_path / "long.txt").write_text("10" * 200_000)
    trace = f'network.loss={{model="trace",file="{tmp_path}/long.txt"}}'
    ending = simulate_run(load(PATH, (*SHORT, trace)), tmp_path)
    assert load_record(ending.run_dir).scenario.network.loss.model == "scripted"
    with pytest.raises(CallerError, match=r"scenario.toml: cannot be read: larger than 1 MiB$"):
        load(ending.run_dir / "scenario.toml")
