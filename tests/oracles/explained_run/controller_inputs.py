"""The controller: its model x_c, which an update resets, and the inputs that follow from it."""

from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix, Vector
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    NO_SEQUENCE,
    PLANT_ACTUATION,
    SENSOR_MEASUREMENT,
)
from tests.oracles.explained_run.findings import ExplainedLoop, is_moderate

CONTROLLER = "controller"


class _State(NamedTuple):
    """The controller between two of its inputs."""

    x_c: Vector
    model_ns: int
    update_ns: int
    """Time of the newest update's event."""
    has_state: bool
    u: Vector


def check_controller(run: ExplainedLoop) -> None:
    """Check x_c at ticks and updates, and the inputs that were sent."""
    ticks, received = run.rows(CONTROLLER_STEP), run.rows(CONTROLLER_DELIVERY)
    measured = run.record[SENSOR_MEASUREMENT]
    sent = measured[measured["event"] != NO_SEQUENCE]
    sent_x = dict(zip(sent["event"].tolist(), sent["x"], strict=True))
    knows_start = run.scenario.network.initial_sync == "known_state"
    n, m = run.loop.n, run.loop.m
    state = _State(run.loop.known_x0 if knows_start else np.zeros(n), 0, 0, knows_start, np.zeros(m))
    rows = sorted([*ticks, *received], key=lambda row: int(row["input"]))
    actuations = {int(row["sequence"]): row for row in run.rows(PLANT_ACTUATION)}
    period = run.scenario.timing.controller_period
    for number, row in enumerate(rows):
        if row["input"] != number or not is_moderate(row["x_c"]):
            return  # rows are missing, or the run diverges
        is_update = "x_c_before" in (row.dtype.names or ())
        if is_update:
            state = _after_update(run, state, row, sent_x.get(int(row["sequence"])))
            continue
        phase_ns = run.scenario.timing.controller_phase_ns
        due_ns = phase_ns + period.time_ns(int(row["sequence"]))
        if row["t_ns"] != due_ns or row["model_t_ns"] != max(due_ns, state.model_ns):
            run.add(row["t_ns"], CONTROLLER, f"tick {row['sequence']} is due at {due_ns} ns")
        state = _after_tick(run, state, row)
        if (actuation := actuations.get(int(row["sequence"]))) is not None:
            _check_actuation(run, state, actuation)


def _after_update(run: ExplainedLoop, state: _State, row: np.void, sent: Vector | None) -> _State:
    """Check that x_c becomes e^{H(t − t_i)} x(t_i)."""
    event_ns = int(row["t_ns"])
    model_ns = max(state.model_ns, event_ns)
    if sent is not None and row["x"].tobytes() != sent.tobytes():
        run.add(event_ns, CONTROLLER, f"update {row['sequence']} has x = {row['x']}, and not {sent}")
    before, after = run.flow(state.x_c, state.model_ns, model_ns), run.flow(row["x"], event_ns, model_ns)
    for name, expected in (("x_c_before", before), ("x_c", after)):
        if not run.is_near(row[name], expected, state.x_c, row["x"]):
            run.add(
                event_ns, CONTROLLER, f"update {row['sequence']}: {name} = {row[name]}, expected {expected}"
            )
    if row["model_t_ns"] != model_ns:
        run.add(
            event_ns, CONTROLLER, f"update {row['sequence']}: model time {row['model_t_ns']}, not {model_ns}"
        )
    return state._replace(x_c=row["x_c"], model_ns=model_ns, update_ns=event_ns, has_state=True)


def _after_tick(run: ExplainedLoop, state: _State, row: np.void) -> _State:
    """Check x_c and u at a tick."""
    model_ns = int(row["model_t_ns"])
    expected = run.flow(state.x_c, state.model_ns, model_ns)
    if not run.is_near(row["x_c"], expected, state.x_c):
        run.add(row["t_ns"], CONTROLLER, f"x_c = {row['x_c']}, but its model leads to {expected}")
    u, scale = _input(run, state, model_ns, row["x_c"], state.u)
    if u is not None and not run.is_near(row["u"], u, scale):
        run.add(row["t_ns"], CONTROLLER, f"u = {row['u']}, expected {u}")
    return state._replace(x_c=row["x_c"], model_ns=model_ns, u=row["u"])


def _input(
    run: ExplainedLoop, state: _State, t_ns: int, x_c: Vector, before: Vector
) -> tuple[Vector | None, Vector]:
    """Return the input for a time, after the input before, and the size of its terms; None: a user's law."""
    controller = run.scenario.controller
    safe = np.zeros(run.loop.m) if controller.safe_input is None else np.array(controller.safe_input)
    if not state.has_state:
        return safe, safe
    if t_ns - state.update_ns >= run.scenario.timing.update_timeout_ns:
        return (before, before) if controller.timeout_input == "hold" else (safe, safe)
    if not controller.is_linear:
        return None, safe
    K, point = run.loop.K, run.point(t_ns)
    x_r, u_r = point[: len(x_c)], point[len(x_c) :]
    return law(K, x_c, x_r, u_r), np.append(np.abs(K) @ np.abs(x_c - x_r), u_r)


def law(K: Matrix, x_c: Vector, x_r: Vector, u_r: Vector) -> Vector:
    """Return K (x_c − x_r) + u_r."""
    return np.asarray(K @ (x_c - x_r) + u_r)


def _check_actuation(run: ExplainedLoop, state: _State, row: np.void) -> None:
    """Check what the plant received of a tick: u, and the inputs for the ticks after it."""
    t_ns, names = state.model_ns, row.dtype.names or ()
    if row["t_ns"] != t_ns or row["u"].tobytes() != state.u.tobytes():
        run.add(
            t_ns, CONTROLLER, f"the plant received u = {row['u']} for {row['t_ns']} ns, sent was {state.u}"
        )
    if "x_c" in names and row["x_c"].tobytes() != state.x_c.tobytes():
        run.add(t_ns, CONTROLLER, f"the plant received x_c = {row['x_c']}, sent was {state.x_c}")
    if "predicted" not in names or not run.scenario.controller.is_linear:
        return
    x, u, x_ns = state.x_c, state.u, t_ns
    period = run.scenario.timing.controller_period
    for k, predicted in enumerate(row["predicted"].reshape(-1, run.loop.m), 1):
        scale = np.zeros(1)
        if state.has_state:
            next_ns = t_ns + int(k * period.exact)
            x, x_ns = run.flow(x, x_ns, next_ns), next_ns
            expected, scale = _input(run, state, x_ns, x, u)
            u = predicted if expected is None else expected
        if not run.is_near(predicted, u, scale):
            run.add(
                t_ns,
                CONTROLLER,
                f"the input predicted for tick {k} after this one is {predicted}, expected {u}",
            )
