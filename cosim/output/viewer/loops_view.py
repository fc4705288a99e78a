"""Writes the recording of a run of several loops at its end, from its records."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cosim.analysis.loops_over_time import loops_over_time, worst_loop
from cosim.output.viewer.loops_recording import ERROR, PICTURED, SIZE, LoopsRecording
from cosim.output.viewer.run_view import feed_record, require_space
from cosim.output.viewer.table_feed import ViewFeed, log_level
from cosim.record.decimate import is_long
from cosim.record.loops_run import loop_directories
from cosim.record.run_record import RunRecord, load_record
from noack.core.clock import NS_PER_S


def write_loops_view(
    network: RunRecord, summary: Mapping[str, Any], run_dir: Path, run_id: int
) -> None:
    """Write the recording of a run of several loops, from its records and its summary.

    Raises:
        ViewError: the recording cannot be written.
    """
    require_space(run_dir)
    directories = loop_directories(run_dir, network.scenario)
    over_time = loops_over_time(network, map(load_record, directories))
    worst = worst_loop(run_dir, summary["loops"])
    few = len(directories) <= PICTURED
    records = {
        number: load_record(directories[number])
        for number in (range(len(directories)) if few else [worst.number])
    }
    loops = {number: record.scenario for number, record in records.items()}
    with LoopsRecording(
        network.scenario, run_dir, run_id, loops, worst=worst, kind=network.kind
    ) as whole:
        flying = summary["network"]["in_flight"]
        largest = np.array(flying["max_by_interval"], np.float64)
        queue_ns = (np.arange(len(largest)) + 0.5) * flying["width_s"] * NS_PER_S
        whole.queue(queue_ns.astype(np.int64), largest, np.array(flying["mean_by_interval"]))
        middles_ns = (over_time.middles_s * NS_PER_S).astype(np.int64)
        whole.norms(ERROR, middles_ns, over_time.errors)
        whole.norms(SIZE, middles_ns, over_time.states)
        whole.map(over_time.errors)
        ends_s, shares = over_time.shares()
        whole.share(((ends_s - ends_s[0] / 2) * NS_PER_S).astype(np.int64), shares)
        for notice in network.notices:
            whole.log(int(notice["t_ns"]), log_level(notice), str(notice["text"]))
        for number, record in records.items():
            columns = record.slice_columns if is_long(record.scenario) else None
            feed = ViewFeed(record.scenario, whole.views[number], columns)
            feed_record(feed, record, run_dir)
