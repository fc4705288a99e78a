"""The plant and its measurements: ẋ = Ax + B(u + d) + w between steps, y = Cx + v."""

from itertools import pairwise

import numpy as np

from cosim.record.rows import Rows
from noack.core.linear_systems import Matrix, Vector
from noack.protocol.record_tables import PLANT_STEP, SENSOR_MEASUREMENT
from noack.scenario.estimation import assumed_model
from tests.oracles.explained_run.findings import ExplainedLoop, bound_at, exponential, is_moderate

PLANT, MEASUREMENT, OBSERVER = "plant", "measurement", "observer"


def check_plant(run: ExplainedLoop) -> None:
    """Check times, states and disturbances of the plant's steps."""
    rows, scenario, n = run.rows(PLANT_STEP), run.scenario, run.loop.n
    period = scenario.timing.plant_period
    if (wrong := rows["t_ns"] != period.times_ns(rows["sequence"])).any():
        row = rows[np.argmax(wrong)]
        run.add(
            row["t_ns"], PLANT, f"step {row['sequence']} is due at {period.time_ns(int(row['sequence']))} ns"
        )
    if len(rows) and rows["sequence"][0] == 0 and not run.is_near(rows["x"][0], run.loop.x0):
        run.add(0, PLANT, f"x(0) = {rows['x'][0]}, and not {run.loop.x0}")
    for name, place, entries in (("d", "input", run.loop.m), ("w", "state", n)):
        if name in (rows.dtype.names or ()):
            beyond = np.abs(rows[name]) > bound_at(scenario, place, entries) * (1 + 1e-12)
            if beyond.any():
                row = rows[np.argmax(beyond.any(axis=1))]
                run.add(row["t_ns"], PLANT, f"the disturbance {row[name]} at the {place} exceeds its bound")
    if scenario.coverage.is_linear:
        _check_flow(run, rows)


def _check_flow(run: ExplainedLoop, rows: Rows) -> None:
    steps: dict[int, tuple[Matrix, Matrix, Matrix]] = {}
    names = rows.dtype.names or ()
    for row, following in pairwise(rows):
        if following["sequence"] != row["sequence"] + 1:
            continue  # rows are missing
        if not is_moderate(row["x"], row["u"], following["x"]):
            return
        dt_ns = int(following["t_ns"] - row["t_ns"])
        if dt_ns not in steps:
            steps[dt_ns] = _step(run.loop.A, run.loop.B, dt_ns * 1e-9)
        Ad, Bd, Gd = steps[dt_ns]
        u = row["u"] + (row["d"] if "d" in names else 0.0)
        parts = [Ad @ row["x"], Bd @ u, *([Gd @ row["w"]] if "w" in names else [])]
        expected = np.sum(parts, axis=0)
        scale = np.abs(Ad) @ np.abs(row["x"])
        if not run.is_near(following["x"], expected, *parts, scale):
            text = f"x = {following['x']}, but dx/dt = Ax + Bu leads to {expected}"
            run.add(following["t_ns"], PLANT, text)


def _step(A: Matrix, B: Matrix, dt_s: float) -> tuple[Matrix, Matrix, Matrix]:
    """Return e^{Ah}, and the integrals of e^{Aτ}B and of e^{Aτ} over a step."""
    n, m = B.shape
    block = np.zeros((2 * n + m, 2 * n + m))
    block[:n] = np.hstack([A, B, np.eye(n)]) * dt_s
    whole = exponential(block)
    return whole[:n, :n], whole[:n, n : n + m], whole[:n, n + m :]


def check_measurements(run: ExplainedLoop) -> None:
    """Check that tests are a period apart, and that what is measured is the plant's state."""
    rows, plant = run.rows(SENSOR_MEASUREMENT), run.rows(PLANT_STEP)
    scenario = run.scenario
    period = scenario.timing.measurement_period
    observed = scenario.observer is not None
    C = scenario.plant.measurement.matrix(run.loop.n)
    std, bound = scenario.plant.measurement.noise(run.loop.n)
    largest = np.where(std > 0, np.inf, bound)
    place = np.searchsorted(plant["t_ns"], rows["t_ns"])
    for row, index in zip(rows, place, strict=True):
        if row["t_ns"] != period.time_ns(int(row["sequence"])):
            run.add(
                row["t_ns"], MEASUREMENT, f"measurement {row['sequence']} is not at a multiple of its period"
            )
        if index == len(plant) or plant["t_ns"][index] != row["t_ns"]:
            run.add(row["t_ns"], MEASUREMENT, "the plant has no step at this time")
            continue
        x, y = plant["x"][index], row["y"] if observed else row["x"]
        if not is_moderate(x, y):
            return
        v, rounding = y - C @ x, 1e-12 * (np.abs(C) @ np.abs(x))
        if (np.abs(v) > largest * (1 + 1e-12) + rounding).any():
            run.add(row["t_ns"], MEASUREMENT, f"y − Cx = {v}, with noise up to {largest}")


def check_observer(run: ExplainedLoop) -> None:
    """Check the estimates x̂, from the outputs and the inputs that the measurements report."""
    observer = run.scenario.observer
    if observer is None:
        return
    rows, model = run.rows(SENSOR_MEASUREMENT), assumed_model(run.scenario)
    gains, x_hat = observer.gains_of(model), _first_estimate(run)
    for number, row in enumerate(rows):
        if row["sequence"] != number or not is_moderate(row["x"], row["y"]):
            return  # rows are missing, or the run diverges
        if number:
            for u in row["u_applied"].reshape(model.steps, -1):
                x_hat = model.Ad @ x_hat + model.Bd @ u
        L = next(gains)
        correction = L @ (row["y"] - model.C @ x_hat)
        expected = x_hat + correction
        if not run.is_near(row["x"], expected, correction, x_hat):
            run.add(row["t_ns"], OBSERVER, f"x̂ = {row['x']}, expected {expected}")
        x_hat = row["x"]


def _first_estimate(run: ExplainedLoop) -> Vector:
    observer = run.scenario.observer
    if observer is not None and observer.initial_estimate is not None:
        return np.array(observer.initial_estimate)
    knows_start = run.scenario.network.initial_sync == "known_state"
    return run.loop.known_x0 if knows_start else np.zeros(run.loop.n)
