"""The recording of a long run is written from its record, reduced; no extreme is lost."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from cosim.live.finalize import finalize
from cosim.output.viewer import blueprint as bp
from cosim.record import decimation, run_record
from cosim.record.record_writing import write_run
from cosim.record.run_directory import RECORDING_FILE, RunEnding, write_environment
from cosim.record.run_record import RunRecord
from cosim.record.run_scenario import write_scenario
from cosim.simulation.virtual_time import simulate
from netem.core.errors import ExitStatus
from noack.protocol.record_tables import CONTROLLER_STEP, PLANT_STEP, SENSOR_MEASUREMENT
from noack.scenario.resolution import ResolvedRun
from tests.cosim.output.viewer.recordings import read, series
from tests.cosim.record.changed_records import changed, copied
from tests.helpers.shipped import resolved
from tests.helpers.summaries import run_of_one_loop

PART_STEPS, COLUMNS = 500, 10
S = 1_000_000_000
PEAKS = 40

Floats = NDArray[np.float64]
Times = NDArray[np.int64]


def with_peaks(record: RunRecord) -> RunRecord:
    """Give single rows values far from those around them."""
    draws = np.random.default_rng(5)
    rows = copied(record)
    for table, columns in ((CONTROLLER_STEP, ("u",)), (SENSOR_MEASUREMENT, ("x", "x_s"))):
        for column in columns:
            for row in draws.integers(0, len(rows[table]), PEAKS):
                entry = draws.integers(rows[table][column].shape[1])
                rows[table][column][row, entry] = draws.normal(scale=1e3)
    return changed(record, rows, kind="live")


def require_envelope(t_ns: Times, values: Floats, kept_ns: Times, kept: Floats) -> None:
    """Every sample lies between the least and the largest kept value of its bin."""
    width_ns = 2 * PART_STEPS * 2_000_000 // COLUMNS
    assert len(t_ns) > 3 * len(kept_ns)
    assert {*kept_ns.tolist()} <= {*t_ns.tolist()}
    for begin_ns in range(0, int(t_ns[-1]) + 1, width_ns):
        end_ns = begin_ns + width_ns
        inside = (t_ns >= begin_ns) & (t_ns < end_ns)
        near = (kept_ns >= begin_ns - width_ns) & (kept_ns < end_ns + width_ns)
        # One bin more on either side: the recording's bins begin at other times.
        assert (values[inside] >= kept[near].min(axis=0)).all()
        assert (values[inside] <= kept[near].max(axis=0)).all()
    for entry in range(values.shape[1]):  # the peaks themselves, each in its bin
        row = int(np.abs(values[:, entry]).argmax())
        assert values[row, entry] in kept[kept_ns == t_ns[row], entry]


def test_each_envelope_holds_all_samples_of_its_bin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    record = with_peaks(simulate(resolved("double_integrator", "horizon_s=20")))
    write_scenario(ResolvedRun(record.scenario), tmp_path)
    write_environment(tmp_path, "live")
    write_run(run_of_one_loop(record), tmp_path)
    steps = record.count(PLANT_STEP)
    monkeypatch.setattr(decimation, "_MOST_STEPS", steps // 2)
    monkeypatch.setattr(run_record, "BATCH_ROWS", PART_STEPS)
    monkeypatch.setattr(RunRecord, "slice_columns", COLUMNS)
    finalize(RunEnding(tmp_path, 7, ExitStatus.OK, "horizon"), report=False)
    chunks = read(tmp_path / RECORDING_FILE)
    inputs = record[CONTROLLER_STEP]
    require_envelope(inputs["t_ns"], inputs["u"], *series(chunks, bp.INPUT))
    measured = record[SENSOR_MEASUREMENT]
    after_reset = np.where(measured["event"][:, None] >= 0, measured["x"], measured["x_s"])
    for i, name in enumerate(record.loop.state_names):
        kept_ns, kept = series(chunks, bp.state_path(name))
        require_envelope(measured["t_ns"], measured["x"][:, i : i + 1], kept_ns, kept[:, :1])
        require_envelope(measured["t_ns"], after_reset[:, i : i + 1], kept_ns, kept[:, 1:2])
