"""Runs that a program starts, opens and evaluates."""

import gc
import json
from collections import Counter
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from matplotlib.figure import Figure

import noack
from cosim.record.align import align_tables
from cosim.record.run_record import load_record


def test_a_run_gives_its_results(simulated: noack.Run) -> None:
    assert simulated.ok
    assert simulated.reason == "horizon"
    document = json.loads((simulated.directory / "summary.json").read_text())
    assert simulated.summary.to_json() == document
    (loop,) = simulated.summary.loops
    assert simulated.claims == loop.claims != []
    assert simulated.scenario.plant.draw == "given"
    for text in (repr(simulated), simulated._repr_html_()):
        assert "own_system" in text
        assert str(loop.events) in text
    assert len(repr(simulated).splitlines()) < 10


def test_a_run_of_several_loops_has_each_loop_as_a_run() -> None:
    network = {"network.loss.probability": 0.5, "horizon_s": 1.0}
    loops = [{"name": "fast", "count": 2}, {"name": "held", "mode": "zoh"}]
    run = noack.simulate(noack.load("double_integrator", network | {"loops": loops}))
    assert run.ok
    assert "3 loops" in repr(run)
    assert list(run.loops) == ["fast-1", "fast-2", "held"]
    events = {name: loop.summary.loops[0].events for name, loop in run.loops.items()}
    assert events == {loop.name: loop.events for loop in run.summary.loops}
    assert sum(events.values()) == len(run.table("netem_packet"))
    assert run.claims == [claim for loop in run.loops.values() for claim in loop.claims]
    steps = run.table("plant_step")["loop"].to_pylist()
    assert set(steps) == {0, 1, 2}
    assert run.loops["fast-2"].table("plant_step").num_rows == steps.count(1)
    assert run.loops["held"].scenario.mode == "zoh"
    assert isinstance(run.plot("loops"), Figure)
    with pytest.raises(noack.NoackError, match=r"3 loops, .* --loop NAME.*; they are fast-1, fast-2, held"):
        run.samples()


def test_a_temporary_run_exists_as_long_as_its_object() -> None:
    run = noack.simulate(noack.load("double_integrator", {"horizon_s": 0.1}))
    folder = run.directory
    assert folder.is_dir()
    assert not (folder / "recording.rrd").exists()
    del run
    gc.collect()
    assert not folder.parent.exists()


@pytest.mark.usefixtures("no_drawing")
def test_a_run_of_the_api_has_an_ordinary_run_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scenario: noack.Scenario
) -> None:
    short = noack.with_settings(scenario, {"horizon_s": 0.1})
    run = noack.simulate(short, runs=tmp_path / "runs")
    assert (run.directory / "recording.rrd").is_file()
    monkeypatch.chdir(tmp_path)
    newest = noack.open_run()
    assert newest.directory.samefile(run.directory)
    assert newest.summary == run.summary
    assert newest.report() == newest.directory / "report.html"


def test_a_table_is_the_file_with_a_column_of_seconds_first(simulated: noack.Run) -> None:
    assert "plant_step" in simulated.tables
    for name in simulated.tables:
        table = simulated.table(name)
        file = pq.read_table(simulated.directory / "record" / f"{name}.parquet")
        named = ["angle", "rate"] if "x_1" in file.column_names else []
        assert table.column_names == ["t_s", *file.column_names, *named]
        assert table.drop_columns(["t_s", *named]).equals(file)
        assert all(table[name].equals(table[f"x_{i}"]) for i, name in enumerate(named, 1))
        np.testing.assert_allclose(table["t_s"].to_numpy(), file["t_ns"].to_numpy() * 1e-9)


def test_samples_are_the_aligned_record(simulated: noack.Run) -> None:
    joined = align_tables(load_record(simulated.directory))
    samples = simulated.samples()
    for name, states in (("x", joined.x), ("x_s", joined.x_s), ("x_c", joined.x_c)):
        for i in range(2):
            np.testing.assert_array_equal(samples[f"{name}_{i + 1}"].to_numpy(), states[:, i])
    e_c = np.hypot(*(samples[f"x_c_{i}"].to_numpy() - samples[f"x_{i}"].to_numpy() for i in (1, 2)))
    np.testing.assert_allclose(e_c, samples["e_c_norm"].to_numpy())
    assert samples["rate"].equals(samples["x_2"])
    assert (samples["event"].to_numpy() >= 0).sum() == simulated.summary.loops[0].events


def test_event_counts_agree_with_the_summary(simulated: noack.Run) -> None:
    events, (summary,) = simulated.events(), simulated.summary.loops
    assert events.num_rows == summary.events
    assert sum(events["received"].to_pylist()) == summary.deliveries
    fates = Counter(events["fate"].to_pylist())
    assert fates["forced"] == summary.forced_deliveries > 0
    assert fates["dropped"] > 0
    lost = {fate: n for fate, n in fates.items() if fate not in ("delivered", "forced")}
    assert lost == summary.drops_by_cause
    intervals_s = events["interval_s"].to_numpy()
    assert np.isnan(intervals_s[0])
    assert intervals_s[1:].min() == pytest.approx(summary.inter_event_min_s)
