"""A simulated run of several loops: its record, its summary, and the commands that read it."""

import json
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner, Result

from cosim.analysis.network_summary import INTERVALS, in_flight, loops_over_time, worst_loop
from cosim.analysis.summary_model import read_summary
from cosim.cli import app
from cosim.live.finalize import reopen
from cosim.output.viewer.live_viewer import opening_time_ns
from cosim.record.align import align_tables
from cosim.record.run_record import load_record, load_run
from noack.core.number_format import number as written
from noack.protocol.record_tables import NETEM_PACKET, PLANT_STEP
from noack.scenario.resolution import network_tables

PATH = Path(__file__).parents[3] / "scenarios" / "shared_bottleneck.toml"
LOOPS = 11


def noack(*arguments: object) -> Result:
    return CliRunner().invoke(app, [*map(str, arguments)])


def simulated(folder: Path, *settings: str, options: Sequence[str] = ()) -> Result:
    words = [word for one in settings for word in ("--set", one)]
    return noack("simulate", PATH, "--runs", folder, "--json", *options, *words)


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    done = simulated(folder, "horizon_s=3")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout) == json.loads((folder / "latest/summary.json").read_text())
    return (folder / "latest").resolve()


def test_the_record_has_each_loop(run_dir: Path) -> None:
    run = load_run(run_dir)
    assert run.names == [*(f"pendulum-{i:02}" for i in range(1, 11)), "periodic"]
    one = load_record(run_dir, "pendulum-07")
    assert (one.scenario.name, one.number) == ("pendulum-07", 6)
    assert set(run.network.tables) == set(network_tables())
    packets = [record.count(NETEM_PACKET) for record in run.loops]
    assert sum(packets) == run.network.count(NETEM_PACKET) > 50
    steps = pq.read_table(run_dir / "record" / f"{PLANT_STEP}.parquet")
    assert steps["loop"].type == pa.uint16()
    assert steps["loop"].to_pylist() == [
        number for number, one in enumerate(run.loops) for _ in range(one.count(PLANT_STEP))
    ]
    for number, record in enumerate(run.loops):
        own = steps.filter(pc.equal(steps["loop"], number))
        assert own["x_1"].to_pylist() == record[PLANT_STEP]["x"][:, 0].tolist()


def test_the_summary_adds_up(run_dir: Path) -> None:
    summary = json.loads((run_dir / "summary.json").read_text())
    assert read_summary(summary) is not None
    assert read_summary(summary | {"loops": summary["loops"][::-1]}) is None
    network, loops = summary["network"], summary["loops"]
    assert [one["number"] for one in loops] == [*range(LOOPS)]
    assert sum(one["link_share"] for one in loops) == pytest.approx(1)
    for one in loops:
        record = load_record(run_dir, one["name"])
        assert one["events"] == len(record.events()) == one["deliveries"] + one["drops"]
    assert sum(one["events"] for one in loops) == network["datagrams"]
    assert sum(network["drops_by_cause"].values()) == sum(one["drops"] for one in loops)
    # Little's law: the mean number in the network is the rate times the mean time in it.
    times_s = sum(one["deliveries"] * (one["delay_mean_s"] or 0.0) for one in loops)
    assert network["in_flight"]["mean"] == pytest.approx(times_s / 3, rel=0.02)


def test_commands_read_the_run_and_its_loops(run_dir: Path) -> None:
    loop = (run_dir, "--loop", "periodic")
    for words in ((run_dir,), loop):
        shown = noack("summary", *words)
        assert shown.exit_code == 0, shown.output
        assert shown.stdout.count("--loop periodic --verbose") == (words == loop)
        replayed = noack("replay", *words, "--json")
        assert replayed.exit_code == 0, replayed.output
        assert json.loads(replayed.stdout)["gaps"] == []
    refused = noack("summary", run_dir, "--loop", "x")
    assert (refused.exit_code, refused.stderr.count("\n")) == (2, 1)
    assert "--loop x: the run has no such loop; it has pendulum-01, " in refused.stderr
    shown = noack("summary", run_dir).stdout
    assert "bottleneck" in shown
    assert "guarantee not checkable in 11 of 11 loops: pendulum-01: no certificate: " in shown
    assert noack("report", *loop).exit_code == 0
    page = run_dir / "report.html"
    before = page.read_text()
    assert noack("report", run_dir, "--again").exit_code == 0
    link = '<a href="report-periodic.html">periodic</a>'
    assert link not in before
    assert link in page.read_text()


@pytest.mark.parametrize("loop", [None, "periodic"])
def test_a_missing_recording_is_written_when_it_is_viewed(run_dir: Path, loop: str | None) -> None:
    path = run_dir / ("recording.rrd" if loop is None else f"recording-{loop}.rrd")
    path.unlink(missing_ok=True)
    done = noack("view", run_dir, "--json", *(() if loop is None else ("--loop", loop)))
    assert json.loads(done.stdout) == {"recording": str(path), "exists": True}
    assert path.read_bytes().startswith(b"RRF")


def test_the_loops_over_time(run_dir: Path) -> None:
    summary, whole = reopen(run_dir).summary, load_run(run_dir)
    found = loops_over_time(whole)
    assert found.errors.shape == found.states.shape == (LOOPS, INTERVALS)
    for number, one in enumerate(summary.loops):
        assert np.nanmax(found.errors[number]) == one.sup_e_c_norm
    # The view opens where the worst loop has its largest error.
    worst = worst_loop(summary.loops).number
    opened_ns = opening_time_ns(run_dir / "recording.rrd")
    assert opened_ns is not None
    at = np.searchsorted(found.edges_s, opened_ns * 1e-9, "right") - 1
    assert found.errors[worst, at] == summary.loops[worst].sup_e_c_norm
    # Loop 6 alone in its first interval; its time begins at its phase.
    phase_ns, run = round(1e9 * summary.loops[6].phase_s), align_tables(whole.loops[6])
    assert phase_ns > 0
    inside = run.t_ns + phase_ns < 3e9 / INTERVALS
    largest = np.linalg.norm(run.x[inside], axis=1).max()
    assert found.states[6, 0] == pytest.approx(largest, rel=1e-12)
    packets = whole.network[NETEM_PACKET]
    left = packets[(packets["release_ns"] >= 0) & (packets["release_ns"] <= 3 * 10**9)]
    assert found.link_bytes.sum() == left["size_bytes"].sum()
    ends_s, shares = found.shares()
    in_second = left[(left["release_ns"] >= 12 * 10**7) & (left["release_ns"] < 24 * 10**7)]
    of_loop = in_second[in_second["flow"] == 10]["size_bytes"].sum()
    assert ends_s[1] == pytest.approx(0.24)
    assert shares[10, 1] == pytest.approx(of_loop / in_second["size_bytes"].sum())


def test_a_loop_that_diverges_is_named_and_the_others_go_on(tmp_path: Path) -> None:
    own = "A = [[0.0, 1.0], [50.0, 0.0]], B = [[0.0], [1.0]]"
    wild = f'{{ name = "wild", phase = 0.75, plant = {{ draw = "given", {own} }} }}'
    loops = f'loops=[{{ name = "calm", count = 2 }}, {wild}]'
    change = 'changes=[{ at_s = 1.5, set = { "network.mansd" = 1 } }]'
    done = simulated(tmp_path, "horizon_s=3", "network.actuation={}", loops, change)
    assert done.exit_code == 1
    summary = json.loads(done.stdout)
    diverged_at_s = summary["loops"][2]["diverged_at_s"] + summary["loops"][2]["phase_s"]
    reason = f"1 of 3 loops failed (wild diverged at {diverged_at_s:.2f} s)"
    assert summary["exit"]["reason"] == reason
    assert [(one["t_s"], one["what"]) for one in summary["changes"]] == [(1.5, "network.mansd = 1")]
    assert [one["exit"]["status"] for one in summary["loops"]] == [0, 0, 1]
    assert summary["reached_s"] == 3
    # Finalised again, it is the same.
    path = tmp_path / "latest/summary.json"
    path.unlink()
    shown = noack("summary", path.parent).stdout.splitlines()
    assert json.loads(path.read_text()) == summary
    (row,) = [line for line in shown if line.startswith(" wild")]
    assert written(summary["loops"][2]["sup_e_c_norm"]) in row
    assert re.match(r"guarantee not checkable in \d of 3 loops: ", shown[1])
    sent = sum(one["actuations"]["sent"] for one in summary["loops"])
    assert any(f" {sent} (" in line for line in shown)


def test_the_number_in_flight_over_time() -> None:
    """Two datagrams overlap from 10 to 20 s; a third did not wait, a fourth was lost."""
    packets = np.zeros(4, network_tables()[NETEM_PACKET])
    packets["copy_ns"] = -1
    packets["now_ns"] = np.array([0, 10, 50, 60]) * 10**9
    packets["release_ns"] = np.array([20 * 10**9, 30 * 10**9, 50 * 10**9, -1])
    found = in_flight(packets, 100 * 10**9, 100 * 10**9)
    assert (found.mean, found.max, found.width_s) == (pytest.approx(0.4), 2, 0.5)
    assert found.max_by_interval[:60] == [1] * 20 + [2] * 20 + [1] * 20
    assert not any(found.max_by_interval[61:])
    assert found.mean_by_interval[20:40] == [2.0] * 20
    assert in_flight(packets, 100 * 10**9, 40 * 10**9).mean == pytest.approx(1.0)  # stopped
