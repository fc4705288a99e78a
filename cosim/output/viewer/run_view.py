"""Creates a run's recording for the viewer, during the run or from its record."""

import errno
import os
import secrets
from pathlib import Path
from shutil import disk_usage

import numpy as np

from cosim.analysis.network_summary import loops_over_time, worst_loop
from cosim.analysis.summary_model import RunSummary
from cosim.analysis.value_reduction import is_long
from cosim.output.viewer.live_viewer import LiveView
from cosim.output.viewer.network_recording import ERROR, PICTURED, SIZE, NetworkRecording
from cosim.output.viewer.pictures.network_picture import NetworkDiagram
from cosim.output.viewer.pictures.picture_choice import picture_of
from cosim.output.viewer.recording import RunView
from cosim.output.viewer.recording_file import ViewError
from cosim.output.viewer.recording_text import about
from cosim.output.viewer.table_feed import ViewFeed, log_level
from cosim.record.run_directory import RECORDING_FILE, Kind, file_of_loop
from cosim.record.run_record import RecordedRun, RunRecord
from noack.config.resolution import loop_of, resolved_loops
from noack.config.scenario import Scenario
from noack.core.clock import NS_PER_S
from noack.protocol.topology import LOOP_ROLES

_INDEXED_S = 120.0
"""Recordings of runs up to this wall time get an index, which needs memory."""

_SPARE_BYTES = 4 * 2**20
"""Free space without which no recording is written from a record."""


def open_view(
    scenario: Scenario, run_dir: Path, run_id: int, live: LiveView | None
) -> RunView | NetworkRecording:
    """Create the recording of a run, which is written while the run goes on."""
    loops = resolved_loops(scenario)
    if len(loops) > 1:
        shown = dict(enumerate(loops)) if len(loops) <= PICTURED else {}
        return NetworkRecording(
            scenario, run_dir, run_id, shown, worst=None, kind="live", live=live
        )
    return loop_view(loops[0], run_dir / RECORDING_FILE, run_id, live)


def loop_view(
    scenario: Scenario,
    path: Path,
    run_id: int,
    live: LiveView | None = None,
    kind: Kind = "live",
    *,
    at_once: bool = False,
) -> RunView:
    """Create the recording of one loop; it is written afterwards, at once or during the run."""
    loop = loop_of(scenario)
    return RunView(
        path,
        run_id=f"{run_id:016x}",
        title=f"{scenario.name} ({scenario.mode})",
        about=about(scenario, kind),
        state_names=loop.state_names,
        input_names=loop.input_names,
        processes=LOOP_ROLES if kind == "live" else (),
        horizon_s=scenario.horizon_s,
        picture=picture_of(scenario),
        diagram=None
        if at_once and is_long(scenario)
        else NetworkDiagram(*scenario.network.flows[1:]),
        live=live,
        clocks=scenario.clocks is not None and kind == "live",
        indexed=at_once or scenario.horizon_s <= _INDEXED_S * scenario.speed,
    )


def write_view(run: RecordedRun, summary: RunSummary, run_dir: Path, loop: str | None) -> None:
    """Write the recording of a run, or of one of its loops, from its record and its summary.

    Raises:
        ViewError: the recording cannot be written.
    """
    require_space(run_dir)
    run_id = secrets.randbits(64)  # the viewer knows recordings by it
    if loop is None and len(run.loops) > 1:
        _write_network_view(run, summary, run_dir, run_id)
        return
    write_loop_view(run.loop(loop), run_dir / file_of_loop(RECORDING_FILE, loop), run_id)


def write_loop_view(record: RunRecord, path: Path, run_id: int) -> None:
    """Write the recording of one loop; that of a long run shows extremes only."""
    require_space(path.parent)
    with loop_view(record.scenario, path, run_id, None, record.kind, at_once=True) as view:
        _feed_record(record, view, path.parent)


def _write_network_view(run: RecordedRun, summary: RunSummary, run_dir: Path, run_id: int) -> None:
    over_time, worst = loops_over_time(run), worst_loop(summary.loops)
    few = len(run.loops) <= PICTURED
    records = {
        number: run.loops[number] for number in (range(len(run.loops)) if few else [worst.number])
    }
    loops = {number: record.scenario for number, record in records.items()}
    with NetworkRecording(
        run.scenario, run_dir, run_id, loops, worst=worst, kind=run.kind
    ) as whole:
        flying = summary.network.in_flight
        largest = np.array(flying.max_by_interval, np.float64)
        queue_ns = (np.arange(len(largest)) + 0.5) * flying.width_s * NS_PER_S
        whole.queue(queue_ns.astype(np.int64), largest, np.array(flying.mean_by_interval))
        middles_ns = (over_time.middles_s * NS_PER_S).astype(np.int64)
        whole.norms(ERROR, middles_ns, over_time.errors)
        whole.norms(SIZE, middles_ns, over_time.states)
        whole.map(over_time.errors)
        ends_s, shares = over_time.shares()
        whole.share(((ends_s - ends_s[0] / 2) * NS_PER_S).astype(np.int64), shares)
        for notice in run.network.notices:
            whole.log(int(notice["t_ns"]), log_level(notice), str(notice["text"]))
        for number, record in records.items():
            _feed_record(record, whole.views[number], run_dir)


def _feed_record(record: RunRecord, view: RunView, run_dir: Path) -> None:
    """Pass a record to a view, part by part, while there is space in its folder."""
    columns = record.slice_columns if is_long(record.scenario) else None
    feed = ViewFeed(record.scenario, view, columns)
    for i, part in enumerate(record.slices()):
        require_space(run_dir)
        if i:
            feed.advance()
        for table, rows in part.items():
            feed.add(table, rows)
    for notice in record.notices:
        feed.log(notice)
    feed.advance(final=True)


def require_space(run_dir: Path) -> None:
    """Raise ViewError if the disk is nearly full: rerun may wait forever after a failed write."""
    if disk_usage(run_dir).free < _SPARE_BYTES:
        path = run_dir / RECORDING_FILE
        raise ViewError(f"{path}: cannot write the recording: {os.strerror(errno.ENOSPC)}")
