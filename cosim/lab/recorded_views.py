"""What the page shows of live and recorded runs, which the worker process computes."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from cosim.interactive.exploration import LIVE, RECORDED, Exploration, from_record
from cosim.interactive.scenario_guarantee import CERTIFIED, Guarantee
from cosim.lazy_modules import lazy_modules
from cosim.output.run_verdict import VerdictLine, remarks, verdict
from cosim.record.record_source import concatenate_rows, rows_by_loop
from cosim.record.run_directory import SCENARIO_FILE
from cosim.record.run_record import RunRecord, load_run
from cosim.record.spool_conversion import merge_segments, spool_segments
from noack.core.linear_systems import Vector
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_SETTING,
    CONTROLLER_STEP,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
)
from noack.runtime.spool import SPOOL
from noack.scenario.resolution import resolved_loops, run_tables, tables_of
from noack.scenario.scenario import phases_ns
from noack.scenario.scenario_file import MOST_RECORDED_BYTES, load

with lazy_modules():  # the worker alone needs them
    from cosim.api import runs
    from cosim.live import finalize
    from cosim.output.figures import run_figures

_READ_TABLES = (SENSOR_MEASUREMENT, CONTROLLER_STEP, CONTROLLER_DELIVERY, CONTROLLER_SETTING, PLANT_STEP)


class RunView(NamedTuple):
    """What the page shows of a recorded loop."""

    run: Exploration
    verdict: tuple[VerdictLine, ...]
    remarks: tuple[str, ...]
    bounds: Guarantee | None
    """Its certified bounds; None without any."""
    loops: tuple[str, ...]
    """Names of the loops of the run."""


def live_view(run_dir: Path) -> Exploration | None:
    """Return what is recorded so far of a run's first loop; None if that is nothing yet."""
    scenario = load(run_dir / SCENARIO_FILE, most_bytes=MOST_RECORDED_BYTES)
    loop = resolved_loops(scenario)[0]
    types, own, tables = run_tables(scenario), tables_of(loop), dict[str, np.ndarray]()
    for table, dtype in own.items():
        rows = np.zeros(0, dtype)
        if table in _READ_TABLES:
            batches = merge_segments(spool_segments(run_dir / SPOOL, table, types[table]), types[table])
            recorded = concatenate_rows([*batches], types[table])
            rows = dict(rows_by_loop(table, recorded, phases_ns(scenario), [own])).get(0, rows)
        tables[table] = rows
    record = RunRecord(loop, tables, [], {})
    view = from_record(record, LIVE) if len(record[CONTROLLER_STEP]) else None
    return view if view is not None and len(view.t_s) else None  # no measurement may be recorded yet


def recorded_view(directory: Path, loop: str | None) -> RunView:
    """Return the view of a loop of a recorded run, by default of its first.

    Raises:
        NoackError: the run is still under way, or its record is damaged.
    """
    summary, run = finalize.reopen(directory).summary, load_run(directory)
    names = tuple(run.names)
    number = run.number_of(loop if loop in names else names[0])
    record = run.loops[number]
    loop_summary = summary.loops[number]
    explored = from_record(record, RECORDED, loop_summary.diverged_at_s)
    texts = tuple(remark.text for remark in remarks(summary.model_copy(update={"loops": [loop_summary]})))
    return RunView(explored, verdict(summary), texts, _bounds(record), names)


def _bounds(record: RunRecord) -> Guarantee | None:
    """Return the certified bounds of ‖e_c‖ and ‖x‖ of a recorded loop."""
    bounds: dict[str, tuple[Vector, Vector]] = {}
    for _, quantity, t_s, values, kind in run_figures.envelopes(record):
        if kind == "certified" and len(t_s):
            bounds.setdefault(quantity, (t_s, values))
    if "e_c" not in bounds:
        return None
    t_s, e_c = bounds["e_c"]
    unknown = np.full(len(t_s), np.nan)
    x = np.asarray(np.interp(t_s, *bounds["x"])) if "x" in bounds else unknown
    return Guarantee(CERTIFIED, "", t_s=t_s, e_s=unknown, e_c=e_c, x=x)


def replay_run(directory: Path) -> str:
    """Replay a run; return in words whether it is bit-exact."""
    result = runs.open_run(directory).replay()
    return (
        "replay: bit-exact, the same numbers again"
        if result.bit_exact
        else f"replay: differs: {result.first_difference}"
    )


def report_page(directory: Path) -> bytes:
    """Return the report of a run, which is written if missing."""
    return finalize.run_report(directory).read_bytes()
