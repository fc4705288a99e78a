"""The recording of several loops: few are all shown, of many the quantiles and the worst."""

from pathlib import Path

import numpy as np

from cosim.analysis.network_summary import INTERVALS, QUANTILES, loops_over_time, summarise_run
from cosim.analysis.run_summary import summarise
from cosim.analysis.summary_model import ExitPart, LoopSummary
from cosim.output.viewer.run_recording import (
    ERROR,
    MAP,
    QUEUE,
    SHARE,
    SIZE,
    map_pixels,
    usual_largest,
    write_view,
)
from cosim.record.run_directory import RECORDING_FILE, write_environment, write_scenario
from cosim.record.run_record import RecordedRun, write_run
from cosim.shipped_files import find_shipped
from cosim.simulation.virtual_time import simulate_loops
from noack.scenario.scenario_file import load
from tests.cosim.output.viewer.test_viewer import Chunks, read, series

MAX_BYTES = 3_000_000


def shown(folder: Path, count: int) -> tuple[RecordedRun, list[LoopSummary], Chunks]:
    """Simulate loops, and read their recording; the last loop but one is the worst."""
    settings = ["horizon_s=0.4", f'loops=[{{ name = "p", count = {count} }}]']
    scenario = load(find_shipped("shared_bottleneck", "scenarios"), settings)
    run = simulate_loops(write_scenario(scenario, folder))
    write_environment(folder, "simulated")
    write_run(run, folder)
    loops = [
        summarise(record, 0, "horizon").model_copy(update={"sup_e_c_norm": float(i == count - 2)})
        for i, record in enumerate(run.loops)
    ]
    end = ExitPart(status=0, reason="horizon")
    write_view(run, summarise_run(run.network, loops, end), folder, None)
    return run, loops, read(folder / RECORDING_FILE)


def test_of_many_loops_quantiles_a_map_and_the_worst_are_recorded(tmp_path: Path) -> None:
    run, _, found = shown(tmp_path, 100)
    over_time = loops_over_time(run)
    assert {one.split("/")[1] for one in found if one.startswith("loops/")} == {"p-099"}
    for entity, values in ((ERROR, over_time.errors), (SIZE, over_time.states)):
        t_ns, drawn = series(found, entity)
        assert len(t_ns) == INTERVALS
        last = np.quantile(values[:, -1], QUANTILES)
        least = np.median(np.nanmax(10**drawn, axis=0)) / 1e5  # curves are cut off below
        np.testing.assert_allclose(10 ** drawn[-1], np.maximum(last, least), rtol=1e-9)
    _, queue = series(found, QUEUE)
    assert queue[:, 0].max() > 1
    assert (queue[:, 1] <= queue[:, 0] + 1e-6).all()
    assert series(found, SHARE)[1][-1, -1] <= 100
    assert MAP in found
    assert (tmp_path / RECORDING_FILE).stat().st_size < MAX_BYTES


def test_a_loop_that_diverges_does_not_hide_the_others() -> None:
    errors = np.array([[1.0, 0.1, 0.01], [0.5, 0.5, 0.5], [1.0, 1e9, 1e20]])
    pixels = map_pixels(errors)
    high, wide = pixels.shape[0] // 3, pixels.shape[1] // 3
    colours = {tuple(pixels[0, place]) for place in (0, wide, 2 * wide)}
    assert len(colours) == 3
    assert tuple(pixels[2 * high, 2 * wide]) == (253, 231, 36)
    assert usual_largest(errors) == 1.0
    assert usual_largest(np.full((2, 3), np.nan)) > 0
