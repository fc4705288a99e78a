"""A recorded or simulated run as the page draws it."""

import numpy as np
import pyarrow as pa

from cosim.api.runs import Run, simulate
from cosim.lab.exploration import SAMPLED, Exploration, key_numbers, threshold_at
from cosim.record.decimate import decimate_all
from noack.config.scenario import Scenario
from noack.core.linear_systems import Matrix, Vector

_COLUMNS = 600
"""Width of the drawn figure; no peak is lost at this width."""


def simulate_sampled(scenario: Scenario) -> Exploration:
    """Run a scenario in virtual time, which takes about a second.

    Raises:
        NoackError: the scenario is wrong.
    """
    return exploration_of(simulate(scenario))


def exploration_of(run: Run) -> Exploration:
    """Return a run's samples, decimated, with its events and key numbers.

    Raises:
        NoackError: the run has several loops, or its record is damaged.
    """
    samples, events, resolved = run.samples(), run.events(), run.scenario
    n = len(resolved.model.state_names or ()) or resolved.model.dimensions[0]
    t_s = _column(samples, "t_s")
    x, x_s, x_c = (_states(samples, name, n) for name in ("x", "x_s", "x_c"))
    e_s_norm, e_c_norm = _column(samples, "e_s_norm"), _column(samples, "e_c_norm")
    curves = np.column_stack([x, x_s, x_c, e_s_norm, e_c_norm])
    kept = decimate_all(t_s, curves, _COLUMNS)
    threshold = threshold_at(resolved, t_s[kept])
    return Exploration(
        resolved, SAMPLED, t_s[kept], x[kept], x_s[kept], x_c[kept], e_s_norm[kept],
        e_c_norm[kept], threshold, _column(events, "t_s"),
        events["received"].to_numpy(zero_copy_only=False).astype(np.bool_),
        run.summary.get("diverged_at_s"), key_numbers(run.summary),
    )  # fmt: skip


def _column(table: pa.Table, name: str) -> Vector:
    return np.asarray(table[name].to_numpy(), dtype=np.float64)


def _states(table: pa.Table, name: str, n: int) -> Matrix:
    return np.column_stack([_column(table, f"{name}_{i}") for i in range(1, n + 1)])
