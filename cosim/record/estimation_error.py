"""The difference between the plant's state and the state that the sensor measures or estimates."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.record.run_record import Rows, RunRecord
from noack.config.scenario import Scenario
from noack.config.state_estimation import steady_state
from noack.core.linear_systems import row_norms
from noack.protocol.record_tables import PLANT_STEP, SENSOR_MEASUREMENT

Reals = NDArray[np.float64]


def true_states(steps: Rows, t_ns: NDArray[np.int64], column: str = "x") -> Reals:
    """Return the plant's own state at some times, (k, n); NaN if its row is missing.

    ``column`` of ``plant_step`` is ``x``, or ``z`` for the whole state of a nonlinear plant.
    """
    found = np.full((len(t_ns), steps[column].shape[1]), np.nan)
    if len(steps):
        place = np.searchsorted(steps["t_ns"], t_ns).clip(max=len(steps) - 1)
        there = steps["t_ns"][place] == t_ns
        found[there] = steps[column][place[there]]
    return found


def estimation_error(record: RunRecord) -> Reals:
    """x̂ − x at each measurement, (k, n); NaN where x is missing."""
    rows = record[SENSOR_MEASUREMENT]
    return np.asarray(rows["x"] - true_states(record[PLANT_STEP], rows["t_ns"]))


def estimation_summary(record: RunRecord, e_c_sup: float | None) -> dict[str, Any] | None:
    """Return the estimation error for a run's summary; None if the sensor measures x itself.

    Args:
        record: the run's record.
        e_c_sup: the largest ‖x_c − x‖, the controller's error against the plant's own state.
    """
    scenario = record.scenario
    if scenario.coverage.knows_state:
        return None
    norms = row_norms(estimation_error(record))
    norms, late = (some[np.isfinite(some)] for some in (norms, norms[len(norms) // 2 :]))
    return {
        "observer": None if scenario.observer is None else scenario.observer.kind,
        "outputs": scenario.message_sizes.outputs,
        "noise_std": np.sqrt(scenario.plant.measurement.variance(record.loop.n)).tolist(),
        "rms": _rms(norms),
        "rms_second_half": _rms(late),
        "expected_rms": expected_rms(scenario),
        "max": float(norms.max()) if len(norms) else None,
        "sup_e_c_norm": e_c_sup,
    }


def expected_rms(resolved: Scenario) -> float:
    """Return the steady-state RMS of ‖x̂ − x‖ from noise and disturbances, for an exact model."""
    return float(np.sqrt(np.trace(steady_state(resolved).covariance)))


def disturbance_summary(record: RunRecord) -> list[dict[str, Any]]:
    """The disturbances of u and of ẋ, for the summary of a run."""
    steps, found = record[PLANT_STEP], []
    for place, column in (("input", "d"), ("state", "w")):
        if column not in (steps.dtype.names or ()):
            continue
        norms = row_norms(steps[column])
        kinds = [one.kind for one in record.scenario.plant.disturbances if one.at == place]
        most = float(norms.max()) if len(norms) else None
        found.append({"at": place, "kinds": kinds, "rms": _rms(norms), "max": most})
    return found


def _rms(values: Reals) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else None
