"""A run's tables against its record and its summary, and as data frames."""

from collections import Counter
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import noack
from cosim.record.align import align_tables
from cosim.record.run_events import packet_outcomes
from cosim.record.run_record import load_record


def test_a_table_is_the_file_with_a_column_of_seconds_first(simulated: noack.Run) -> None:
    assert "plant_step" in simulated.tables
    for name in simulated.tables:
        table = simulated.table(name)
        file = pq.read_table(simulated.directory / "record" / f"{name}.parquet")
        assert table.column_names == ["t_s", *file.column_names]
        assert table.drop_columns(["t_s"]).equals(file)
        np.testing.assert_allclose(table["t_s"].to_numpy(), file["t_ns"].to_numpy() * 1e-9)


def test_samples_are_the_aligned_record(simulated: noack.Run) -> None:
    joined = align_tables(load_record(simulated.directory))
    samples = simulated.samples()
    for name, states in (("x", joined.x), ("x_s", joined.x_s), ("x_c", joined.x_c)):
        for i in range(2):
            np.testing.assert_array_equal(samples[f"{name}_{i + 1}"].to_numpy(), states[:, i])
    e_c = np.hypot(*(samples[f"x_c_{i}"].to_numpy() - samples[f"x_{i}"].to_numpy() for i in (1, 2)))
    np.testing.assert_allclose(e_c, samples["e_c_norm"].to_numpy())
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


def test_stale_and_in_flight_updates_are_marked(scenario: noack.Scenario) -> None:
    """Delays of up to half a second: some updates arrive out of order, some after the end."""
    jitter = {"kind": "delay", "delay_s": 0.3, "jitter_s": 0.25}
    run = noack.simulate(
        noack.with_settings(scenario, {"network.impairments": [jitter], "horizon_s": 2.0})
    )
    crossed = packet_outcomes(load_record(run.directory))
    fates = Counter(run.events()["fate"].to_pylist())
    assert (
        fates["delivered_out_of_order"]
        == run.summary.loops[0].drops_by_cause["delivered_out_of_order"]
        > 0
    )
    assert fates["in_flight"] == crossed.in_flight.sum()


def test_a_damaged_table_gives_one_line(tmp_path: Path, scenario: noack.Scenario) -> None:
    run = noack.simulate(noack.with_settings(scenario, {"horizon_s": 0.1}), runs=tmp_path)
    assert run.tables
    (run.directory / "record/plant_step.parquet").write_bytes(b"PAR1")
    with pytest.raises(noack.NoackError, match=r"plant_step\.parquet: cannot be read"):
        run.table("plant_step")


def test_pandas_takes_every_table(simulated: noack.Run) -> None:
    pytest.importorskip("pandas", reason="pandas is not installed")
    frame = simulated.samples().to_pandas()
    assert list(frame.columns)[:3] == ["t_s", "t_ns", "x_1"]
    assert frame["t_s"].is_monotonic_increasing
    assert simulated.table("plant_step").to_pandas().columns[0] == "t_s"
    events = simulated.events().to_pandas()
    assert events.loc[events.fate == "forced", "received"].all()
