"""A simulated run of several loops: its record, its summary, and the commands that read it."""

import json
import re
import shutil
import tomllib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner, Result

from cosim.analysis.network_summary import (
    INTERVALS,
    QUANTILES,
    LoopsOverTime,
    in_flight,
    loops_over_time,
    quantiles,
    worst_loop,
)
from cosim.analysis.summary_model import ExitPart, ReplayPart, read_summary
from cosim.cli import app
from cosim.live.finalize import finalize, reopen
from cosim.output.figure_drawing import draw
from cosim.output.network_figures import error_map, norms_figure
from cosim.output.run_tables import loop_row, network_rows
from cosim.output.viewer.live_viewer import opening_time_ns
from cosim.record.align import align_tables
from cosim.record.run_directory import RunEnding, write_environment
from cosim.record.run_record import RunRecord, load_record, load_run
from noack.core.errors import ExitStatus
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


def test_processes_finalise_the_loops_of_a_long_run_alike(
    run_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = run_dir / "summary.json"
    before = path.read_text()
    path.unlink()
    monkeypatch.setattr("cosim.live.end_helpers._MANY_STEPS", 1)
    monkeypatch.setattr("cosim.live.end_helpers.cores", lambda: 2)
    assert noack("summary", run_dir).exit_code == 0
    assert path.read_text() == before


def test_a_run_in_which_no_loop_sent_anything_has_not_failed(
    run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    again = tmp_path / "again"
    shutil.copytree(run_dir, again)
    write_environment(again, "live")

    def replayed(record: RunRecord, *_: object) -> ReplayPart:
        return ReplayPart(bit_exact=None if record.is_network else True)

    monkeypatch.setattr("cosim.live.finalize._replay", replayed)
    summary = finalize(RunEnding(again, 0, ExitStatus.OK, "horizon"), report=False).summary
    assert summary.network.replay == ReplayPart(bit_exact=None)
    assert summary.exit.status == ExitStatus.OK


def test_the_summary_adds_up(run_dir: Path) -> None:
    summary = json.loads((run_dir / "summary.json").read_text())
    typed = read_summary(summary)
    assert typed is not None
    assert read_summary(summary | {"loops": summary["loops"][::-1]}) is None
    network, loops = summary["network"], summary["loops"]
    assert [one["number"] for one in loops] == [*range(LOOPS)]
    assert sum(one["link_share"] for one in loops) == pytest.approx(1)
    stopped, failed = (ExitPart(status=status, reason="") for status in (130, 1))
    assert "failed" not in loop_row(typed.loops[0].model_copy(update={"exit": stopped}))[-1]
    assert "failed" in loop_row(typed.loops[0].model_copy(update={"exit": failed}))[-1]
    for one in loops:
        record = load_record(run_dir, one["name"])
        assert one["events"] == len(record.events()) == one["deliveries"] + one["drops"]
    assert sum(one["events"] for one in loops) == network["datagrams"]
    assert sum(network["drops_by_cause"].values()) == sum(one["drops"] for one in loops)
    # Little's law: the mean number in the network is the rate times the mean time in it.
    times_s = sum(one["deliveries"] * (one["delay_mean_s"] or 0.0) for one in loops)
    assert network["in_flight"]["mean"] == pytest.approx(times_s / 3, rel=0.02)
    # A run that was stopped at half of its horizon.
    stopped_run = typed.model_copy(update={"reached_s": 1.5})
    assert f"({network['datagrams'] / 1.5:.4g} /s)" in network_rows(stopped_run)[0][1]


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


LATE = "certificate.network_delay_s=0.001"
LOST = "network.actuation={ mansd = 4, loss = { model = 'bernoulli', probability = 0.6 } }"


@pytest.mark.parametrize("setting", [LATE, LOST])
def test_the_whole_says_why_claims_are_void_and_that_watchdogs_acted(
    setting: str, tmp_path: Path
) -> None:
    watchdog = 'plant.watchdog={ policy = "zero", timeout_s = 0.03 }'
    words = [setting, watchdog] if setting == LOST else [setting]
    assert simulated(tmp_path, "horizon_s=2", *words).exit_code == 0
    loops = json.loads((tmp_path / "latest/summary.json").read_text())["loops"]
    trips = sum(one["watchdog"]["trips"] for one in loops)
    claims = [claim for one in loops for claim in one["claims"]]
    reasons = {claim["why"] for claim in claims if claim["verdict"] == "void"}
    assert trips if setting == LOST else reasons
    shown = noack("summary", tmp_path / "latest").stdout
    assert (f"{trips} times, in {LOOPS} loops" in shown) == (setting == LOST)
    assert len(re.findall("^void: ", shown, re.MULTILINE)) == min(len(reasons), 3)


@pytest.mark.parametrize("loop", [None, "periodic"])
def test_a_missing_recording_is_written_when_it_is_viewed(run_dir: Path, loop: str | None) -> None:
    path = run_dir / ("recording.rrd" if loop is None else f"recording-{loop}.rrd")
    path.unlink(missing_ok=True)
    done = noack("view", run_dir, "--json", *(() if loop is None else ("--loop", loop)))
    assert json.loads(done.stdout) == {"recording": str(path), "exists": True}
    assert path.read_bytes().startswith(b"RRF")


def test_the_loops_over_time(run_dir: Path) -> None:
    summary = reopen(run_dir).summary
    whole = load_run(run_dir)
    network, found = whole.network, loops_over_time(whole)
    assert found.errors.shape == found.states.shape == (LOOPS, INTERVALS)
    for number, one in enumerate(summary.loops):
        assert np.nanmax(found.errors[number]) == one.sup_e_c_norm
    # The view opens where the worst loop has its largest error.
    worst = worst_loop(summary.loops).number
    opened_ns = opening_time_ns(run_dir / "recording.rrd")
    assert opened_ns is not None
    at = np.searchsorted(found.edges_s, opened_ns * 1e-9, "right") - 1
    assert found.errors[worst, at] == summary.loops[worst].sup_e_c_norm
    # Loop 6 alone, interval by interval; its time begins at its phase.
    phase_ns, run = round(1e9 * summary.loops[6].phase_s), align_tables(whole.loops[6])
    assert phase_ns > 0
    edges_ns = np.linspace(0, 3e9, INTERVALS + 1)
    for i in (0, 50, 199):
        t_ns = run.t_ns + phase_ns
        inside = (t_ns >= edges_ns[i]) & ((t_ns < edges_ns[i + 1]) | (i == INTERVALS - 1))
        largest = np.linalg.norm(run.x[inside], axis=1).max()
        assert found.states[6, i] == pytest.approx(largest, rel=1e-12)
    packets = network[NETEM_PACKET]
    left = packets[(packets["release_ns"] >= 0) & (packets["release_ns"] <= 3 * 10**9)]
    assert found.link_bytes.sum() == left["size_bytes"].sum()
    ends_s, shares = found.shares()
    in_second = left[(left["release_ns"] >= 12 * 10**7) & (left["release_ns"] < 24 * 10**7)]
    of_loop = in_second[in_second["flow"] == 10]["size_bytes"].sum()
    assert ends_s[1] == pytest.approx(0.24)
    assert shares[10, 1] == pytest.approx(of_loop / in_second["size_bytes"].sum())


def test_quantiles_over_loops_ignore_what_is_unknown() -> None:
    values = np.random.default_rng(3).normal(size=(50, 7))
    values[:, 3] = np.nan
    values[4:, 5] = np.inf
    found = quantiles(values)
    np.testing.assert_allclose(found[:, 0], np.quantile(values[:, 0], QUANTILES))
    np.testing.assert_allclose(found[:, 5], np.quantile(values[:4, 5], QUANTILES))
    assert np.isnan(found[:, 3]).all()


def test_a_loop_that_diverged_does_not_hide_the_others() -> None:
    values = np.random.default_rng(1).uniform(0.1, 1, (3, INTERVALS))
    values[1] *= 10.0 ** np.linspace(0, 20, INTERVALS)
    over_time = LoopsOverTime(np.linspace(0, 2, INTERVALS + 1), values, values, values)
    names, stayed = ["a", "b", "c"], np.array([True, False, True])
    for axes in draw(norms_figure(over_time, names, stayed)).axes:
        assert axes.get_ylim()[0] < 0.1
        assert axes.get_ylim()[1] < 1e7
    for known, most in ((stayed, values[stayed].max()), (np.full(3, False), values.max())):
        scale = error_map(over_time, names, known).scale
        assert scale is not None
        assert scale.high == most


def test_the_worst_loop(run_dir: Path) -> None:
    """A loop that failed, else the largest share of a certified bound, else the largest ‖e_c‖."""
    loops = [
        loop.model_copy(update={"claims": [], "sup_e_c_norm": error})
        for loop, error in zip(reopen(run_dir).summary.loops, (0.1, None, 0.3), strict=False)
    ]
    assert worst_loop(loops).number == 2
    claim = reopen(run_dir).summary.loops[0].claims[0]
    claims = [
        claim.model_copy(update={"source": source, "bound": bound, "ratio": ratio})
        for source, bound, ratio in (
            ("(I1)", "‖e_c‖ ≤ 1", 7.0),
            ("certificate", "‖e_c‖ ≤ 1", 0.25),
            ("certificate", "none", None),
        )
    ]
    loops[1] = loops[1].model_copy(update={"claims": claims})
    worst = worst_loop(loops)
    assert worst.number == 1
    assert worst.why.endswith(": 25 %")
    failed = ExitPart(status=1, reason="diverged")
    loops[0] = loops[0].model_copy(update={"exit": failed})
    assert worst_loop(loops) == (0, "diverged")


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
    # Finalised again, it is the same; and the tables show all numbers in 80 columns.
    path = tmp_path / "latest/summary.json"
    path.unlink()
    shown = noack("summary", path.parent).stdout.splitlines()
    assert json.loads(path.read_text()) == summary
    # Certificates do not cover actuations that are lost without a bound.
    assert re.match(r"guarantee not checkable in \d of 3 loops: ", shown[1])
    (row,) = [line for line in shown if line.startswith(" wild")]
    assert written(summary["loops"][2]["sup_e_c_norm"]) in row
    sent = sum(one["actuations"]["sent"] for one in summary["loops"])
    assert sent == pytest.approx(3 * 3 * 100, abs=6)
    assert any(f" {sent} (" in line for line in shown)
    assert any(re.search(r"changed at 1.500 s .* network.mansd = 1 ", line) for line in shown)
    table = [line for line in shown if not line.startswith(("one loop", "more: ", "guarantee"))]
    assert max(map(len, table)) <= 80


def test_check_prints_the_loops_and_refuses_a_link_that_is_too_slow() -> None:
    done = noack("check", PATH)
    assert done.exit_code == 0
    assert tomllib.loads(done.stdout)["loops"][0]["count"] == 10
    assert "# pendulum-10: begins at 0.00" in done.stdout
    assert "# network.impairments.0: 100000 bit/s; datagrams that must pass: 920 to " in done.stdout
    slow = 'network.impairments=[{ kind = "rate", rate_bps = 900 }]'
    for command in ("check", "simulate"):
        refused = noack(command, PATH, "--set", slow)
        assert refused.exit_code == 2
        assert "need 920 bit/s" in refused.stderr


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


def test_the_copies_of_a_duplication_use_the_bottleneck(tmp_path: Path) -> None:
    """And not the ones that are made behind it; a datagram of two states has 736 bits on it."""
    rate, twice = '{ kind = "rate", rate_bps = 1000000 }', '{ kind = "duplicate", probability = 1 }'
    for stages, times in ((f"[{twice}, {rate}]", 2), (f"[{rate}, {twice}]", 1)):
        settings = (
            "horizon_s=1.0",
            "network.loss.probability=0.0",
            f"network.impairments={stages}",
        )
        done = simulated(tmp_path, *settings, options=["--no-report"])
        network = json.loads(done.stdout)["network"]
        used = network["datagrams"] * times * 736 / 1e6
        assert network["utilisation"] == pytest.approx(used, rel=0.1)  # the last may leave later
