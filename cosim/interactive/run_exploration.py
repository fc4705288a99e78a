"""A run in virtual time, as a page or notebook draws it."""

import tempfile
from pathlib import Path

import numpy as np
import pyarrow as pa

from cosim.analysis.value_reduction import decimate_all
from cosim.interactive.exploration import (
    SAMPLED,
    Exploration,
    explore,
    key_numbers,
    threshold_at,
    why_not_exact,
)
from cosim.live.finalize import finalize
from cosim.live.simulated_run import simulate_run
from cosim.record.align import align_tables
from cosim.record.data_frames import events, samples
from cosim.record.run_record import load_record
from noack.config.scenario import Scenario
from noack.core.linear_systems import Matrix, Vector

_COLUMNS = 600
"""Width of the drawn figure; no peak is lost at this width."""


def run_of(scenario: Scenario) -> Exploration:
    """Run a scenario exactly if the exact simulation covers it, else in virtual time.

    Raises:
        NoackError: the scenario is wrong, or has several loops.
    """
    return explore(scenario) if why_not_exact(scenario) is None else simulate_sampled(scenario)


def simulate_sampled(scenario: Scenario) -> Exploration:
    """Run a scenario in virtual time, which takes about a second; decimate its samples.

    Raises:
        NoackError: the scenario is wrong, or has several loops.
    """
    with tempfile.TemporaryDirectory(prefix="noack-") as folder:
        ending = simulate_run(scenario, Path(folder))
        outcome = finalize(ending, report=False, view=False)
        record, (loop,) = load_record(outcome.run_dir), outcome.summary.loops
        sampled, sent, resolved = samples(record), events(record), record.scenario
        known = align_tables(record).since_delivery(resolved)
    n = len(resolved.model.state_names or ()) or resolved.model.dimensions[0]
    t_s = _column(sampled, "t_s")
    x, x_s, x_c = (_states(sampled, name, n) for name in ("x", "x_s", "x_c"))
    e_s_norm, e_c_norm = _column(sampled, "e_s_norm"), _column(sampled, "e_c_norm")
    x_c, e_c_norm = np.where(known[:, None], x_c, np.nan), np.where(known, e_c_norm, np.nan)
    curves = np.column_stack([x, x_s, x_c, e_s_norm, e_c_norm])
    kept = decimate_all(t_s, curves, _COLUMNS)
    threshold = threshold_at(resolved, t_s[kept])
    return Exploration(
        resolved, SAMPLED, t_s[kept], x[kept], x_s[kept], x_c[kept], e_s_norm[kept],
        e_c_norm[kept], threshold, _column(sent, "t_s"),
        sent["received"].to_numpy(zero_copy_only=False).astype(np.bool_),
        loop.diverged_at_s, key_numbers(loop.to_json()),
    )  # fmt: skip


def _column(table: pa.Table, name: str) -> Vector:
    return np.asarray(table[name].to_numpy(), dtype=np.float64)


def _states(table: pa.Table, name: str, n: int) -> Matrix:
    return np.column_stack([_column(table, f"{name}_{i}") for i in range(1, n + 1)])
