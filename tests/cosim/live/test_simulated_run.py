"""A simulated run gives a run directory that all readers of run directories accept."""

import json
from pathlib import Path

import pytest
import rerun.chunk
from typer.testing import CliRunner, Result

import cosim.live.finalize
from cosim.analysis.summary_model import RunSummary
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

ROOT = Path(__file__).parents[3]
SHORT = ("horizon_s=2", "plant.rate_hz=100", "controller.rate_hz=100", "trigger.beta=0.05")
PATH = ROOT / "scenarios" / "double_integrator.toml"


def noack(*arguments: str) -> Result:
    return CliRunner().invoke(app, arguments)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    settings = [word for setting in SHORT for word in ("--set", setting)]
    done = noack("simulate", str(PATH), "--runs", str(folder), "--json", *settings)
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout) == json.loads((folder / "latest/summary.json").read_text())
    return folder


def test_a_simulated_run_has_the_files_of_a_live_run(runs: Path) -> None:
    run_dir = runs / "latest"
    assert {path.name for path in run_dir.iterdir()} == {
        "scenario.toml", "environment.json", "record", "recording.rrd", "reports.json",
        "summary.json", "report.html", "ending.json", "logs", ".lock",
    }  # fmt: skip
    assert json.loads((run_dir / "environment.json").read_text())["kind"] == "simulated"
    assert {path.name for path in (run_dir / "record").iterdir()} == {
        *(f"{table}.parquet" for table in tables(2, 1)),
        "notices.jsonl",
    }


@pytest.fixture
def reported(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Run directories for which a report would be written."""
    written: list[Path] = []

    def report(run: RecordedRun, summary: RunSummary, run_dir: Path, loop: str | None) -> Path:
        written.append(run_dir)
        return run_dir / "report.html"

    monkeypatch.setattr(cosim.live.finalize, "_write_report", report)
    return written


def test_a_report_can_be_omitted_and_written_later(tmp_path: Path, reported: list[Path]) -> None:
    settings = [word for setting in SHORT for word in ("--set", setting)]
    done = noack("simulate", str(PATH), "--runs", str(tmp_path), "--no-report", *settings)
    assert done.exit_code == 0, done.output
    assert "report.html" not in done.stdout
    assert reported == []
    assert noack("report", "--runs", str(tmp_path)).exit_code == 0
    assert reported == [(tmp_path / "latest").resolve()]


def test_the_record_on_disk_equals_the_simulators(runs: Path) -> None:
    again, loaded = simulate(resolve(load(PATH, SHORT))), load_record(runs / "latest")
    assert all(again[table].tobytes() == loaded[table].tobytes() for table in again.tables)
    assert loaded.scenario == again.scenario
    assert loaded.kind == again.kind == "simulated"
    assert loaded.reports == again.reports
    assert loaded.notices == again.notices


def test_the_recording_of_a_simulated_run_has_no_lateness(runs: Path) -> None:
    reader = rerun.chunk.RrdReader(runs / "latest" / "recording.rrd")
    (store,) = reader.recordings()
    paths = {chunk.entity_path.removeprefix("/") for chunk in reader.stream(store=store)}
    assert blueprint.EVENT in paths
    assert blueprint.INPUT in paths
    assert not [path for path in paths if path.startswith("lateness")]


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
    folder = tmp_path / "old"
    folder.mkdir()
    for path in (runs / "latest").iterdir():
        (folder / path.name).symlink_to(path)
    (folder / "environment.json").unlink()
    assert load_record(folder).kind == "live"
    write_environment(folder, "simulated")
    assert load_record(folder).kind == "simulated"


def test_a_recorded_scenario_may_exceed_the_size_limit_of_scenarios(tmp_path: Path) -> None:
    (tmp_path / "long.txt").write_text("10" * 200_000)
    trace = f'network.loss={{model="trace",file="{tmp_path}/long.txt"}}'
    ending = simulate_run(load(PATH, (*SHORT, trace)), tmp_path)
    assert load_record(ending.run_dir).scenario.network.loss.model == "scripted"
    with pytest.raises(CallerError, match=r"scenario.toml: cannot be read: larger than 1 MiB$"):
        load(ending.run_dir / "scenario.toml")
