"""Simulated runs of one loop and of several: their directories, summaries, and commands."""

import json
import re
from collections.abc import Sequence
from pathlib import Path

import pytest
import rerun.chunk
from typer.testing import Result

from cosim.analysis.summary.summary_model import ReplayPart, read_summary
from cosim.live.finalize import finalize
from cosim.output.viewer import blueprint
from cosim.record.run_directory import RunEnding, write_environment
from cosim.record.run_record import RecordedRun, RunRecord, load_record
from cosim.simulation.virtual_time import Progress, simulate_run
from netem.core.errors import ExitStatus, MachineError
from netem.core.number_format import number as written
from noack.protocol.record_tables import tables
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load
from tests.helpers.command_line import invoke

PATH = Path(__file__).parents[3] / "scenarios" / "shared_bottleneck.toml"
LOOPS = (
    'loops=[{ name = "pendulum", count = 2 }, '
    '{ name = "periodic", trigger = { policy = "periodic", period_s = 0.2 } }]'
)
NARROW = 'network.impairments=[{ kind = "rate", rate_bps = 20_000, queue = 3 }]'
"""For three loops instead of eleven."""
ONE_LOOP = Path(__file__).parents[3] / "scenarios" / "double_integrator.toml"
SETTINGS = ("horizon_s=2", "plant.rate_hz=100", "controller.rate_hz=100", "trigger.beta=0.05")


def simulated(folder: Path, *settings: str, options: Sequence[str] = ()) -> Result:
    words = [word for setting in settings for word in ("--set", setting)]
    return invoke("simulate", PATH, "--runs", folder, "--json", *options, *words)


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    result = simulated(folder, "horizon_s=3", LOOPS, NARROW, options=["--no-report"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout) == json.loads((folder / "latest/summary.json").read_text())
    return (folder / "latest").resolve()


def test_a_live_run_in_which_no_loop_sent_anything_has_not_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario = load(ONE_LOOP, [*SETTINGS, 'loops=[{ name = "p", count = 2 }]'])
    run_dir = simulate_run(scenario, tmp_path).run_dir
    write_environment(run_dir, "live")

    def replayed(record: RunRecord, *_: object) -> ReplayPart:
        return ReplayPart(bit_exact=None if record.is_network else True)

    monkeypatch.setattr("cosim.live.finalize._replay", replayed)
    ending = RunEnding(run_dir, 0, ExitStatus.OK, "horizon")
    summary = finalize(ending, report=False, view=False).summary
    assert summary.network.replay == ReplayPart(bit_exact=None)
    assert summary.exit.status == ExitStatus.OK


def test_the_counts_of_the_loops_add_up_to_those_of_the_network(run_dir: Path) -> None:
    summary = json.loads((run_dir / "summary.json").read_text())
    assert read_summary(summary) is not None
    assert read_summary(summary | {"loops": summary["loops"][::-1]}) is None
    network, loops = summary["network"], summary["loops"]
    assert [part["number"] for part in loops] == [0, 1, 2]
    assert sum(part["link_share"] for part in loops) == pytest.approx(1)
    for part in loops:
        record = load_record(run_dir, part["name"])
        assert part["events"] == len(record.events()) == part["deliveries"] + part["drops"]
    assert sum(part["events"] for part in loops) == network["datagrams"]
    assert sum(network["drops_by_cause"].values()) == sum(part["drops"] for part in loops)
    # Little's law: the mean number in the network is the rate times the mean time in it, but at the ends.
    times_s = sum(part["deliveries"] * (part["delay_mean_s"] or 0.0) for part in loops)
    assert network["in_flight"]["mean"] == pytest.approx(times_s / 3, rel=0.05)


def test_a_run_and_each_loop_can_be_summarised_and_replayed(run_dir: Path) -> None:
    for options in ((), ("--loop", "periodic")):
        output = invoke("summary", run_dir, *options)
        assert output.exit_code == 0, output.output
        assert ("--loop periodic --verbose" in output.stdout) == bool(options)
        replayed = invoke("replay", run_dir, *options, "--json")
        assert replayed.exit_code == 0, replayed.output
        assert json.loads(replayed.stdout)["gaps"] == []
    output = invoke("summary", run_dir).stdout
    assert "bottleneck" in output
    assert "guarantee not checkable in 1 of 3 loops: periodic: no certificate: " in output
    result = invoke("summary", run_dir, "--loop", "x")
    assert (result.exit_code, result.stderr.count("\n")) == (2, 1)
    assert "noack: x: the run has no such loop; it has pendulum-1, " in result.stderr


def test_a_run_that_is_simulated_again_has_the_same_bits(run_dir: Path, tmp_path: Path) -> None:
    result = invoke("simulate", run_dir, "--runs", tmp_path, "--no-report")
    assert result.exit_code == 0, result.output
    names = {path.name for path in (run_dir / "record").glob("*.parquet")}
    assert "netem_packet.parquet" in names
    for name in names:
        repeated = tmp_path / "latest" / "record" / name
        assert repeated.read_bytes() == (run_dir / "record" / name).read_bytes()


@pytest.mark.usefixtures("no_report", "no_recording")
def test_a_loop_that_diverges_is_named_and_the_others_go_on(tmp_path: Path) -> None:
    own = "A = [[0.0, 1.0], [50.0, 0.0]], B = [[0.0], [1.0]]"
    wild = f'{{ name = "wild", phase = 0.75, plant = {{ draw = "given", {own} }} }}'
    loops = f'loops=[{{ name = "calm", count = 2 }}, {wild}]'
    change = 'changes=[{ at_s = 1.5, set = { "network.mansd" = 1 } }]'
    settings = ("horizon_s=3", "network.actuation={}", loops, change)
    result = simulated(tmp_path, *settings, options=["--no-report"])
    assert result.exit_code == 1
    summary = json.loads(result.stdout)
    diverged_at_s = summary["loops"][2]["diverged_at_s"] + summary["loops"][2]["phase_s"]
    reason = f"1 of 3 loops failed (wild diverged at {diverged_at_s:.2f} s)"
    assert summary["exit"]["reason"] == reason
    assert [(change["t_s"], change["what"]) for change in summary["changes"]] == [(1.5, "network.mansd = 1")]
    assert [part["exit"]["status"] for part in summary["loops"]] == [0, 0, 1]
    assert summary["reached_s"] == 3
    # Finalised again, it is the same.
    path = tmp_path / "latest/summary.json"
    path.unlink()
    shown = invoke("summary", path.parent).stdout.splitlines()
    assert json.loads(path.read_text()) == summary
    (row,) = [line for line in shown if line.startswith(" wild")]
    assert written(summary["loops"][2]["sup_e_c_norm"]) in row
    assert re.match(r"guarantee not checkable in \d of 3 loops: ", shown[1])
    sent = sum(part["actuations"]["sent"] for part in summary["loops"])
    assert any(f" {sent} (" in line for line in shown)


# --- one loop -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run without a report, of which one was written later."""
    folder = tmp_path_factory.mktemp("runs")
    settings = [word for setting in SETTINGS for word in ("--set", setting)]
    words = ("simulate", str(ONE_LOOP), "--runs", str(folder), "--json", "--no-report")
    result = invoke(*words, *settings)
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout) == json.loads((folder / "latest/summary.json").read_text())
    assert not (folder / "latest/report.html").exists()
    assert invoke("report", "--runs", str(folder)).exit_code == 0
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


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(28, "No space left on device")])
def test_an_interrupted_simulation_leaves_no_run_directory(
    tmp_path: Path, error: BaseException, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(scenario: Scenario, progress: Progress | None) -> RecordedRun:
        raise error

    monkeypatch.setattr("cosim.simulation.virtual_time.simulate_loops", broken)
    expected = MachineError if isinstance(error, OSError) else type(error)
    with pytest.raises(expected):
        simulate_run(load(ONE_LOOP, SETTINGS), tmp_path)
    assert list(tmp_path.iterdir()) == []
