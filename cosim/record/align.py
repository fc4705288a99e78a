"""Aligns the tables of a run on the time grid of the measurements.

At each measurement time t:

* x(t) and x_s(t) are the sensor's values; at an event x_s is the value after its reset. x is
  measured or estimated by the sensor. With noise or an observer it is not the plant's state
  (:func:`true_states`), and e_c is the controller's error relative to this x;
* x_c(t) is the controller's last state with a model time t' ≤ t, propagated by e^{H(t−t')};
* the plant's own state is known at each of its steps, also between measurements
  (:class:`PlantStates`);
* :func:`identity_residual` compares x_c − x_s with (I1).
"""

from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.record.rows import concatenate_rows
from cosim.record.run_events import model_flow_of
from cosim.record.run_record import Rows, RunRecord
from netem.core.row_operations import all_entries, firsts_of_equal, largest_sizes, row_norms, set_rows
from noack.core.references import ModelFlow
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    NO_SEQUENCE,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
)
from noack.scenario.resolution import LoopMatrices, loop_of, policy_of
from noack.scenario.scenario import Scenario
from noack.theory.paper import ErrorMonitor

Times = NDArray[np.int64]
Reals = NDArray[np.float64]


class AlignedRun(NamedTuple):
    """Samples on the measurement grid; k samples, n states."""

    t_ns: Times
    """(k,)"""
    x: Reals
    """(k, n), measured or estimated by the sensor."""
    x_s: Reals
    """(k, n), after a reset."""
    x_c: Reals
    """(k, n); NaN at times without a recorded controller state."""
    x_norm: Reals
    """(k,) ‖x‖."""
    e_s_norm: Reals
    """(k,) ‖e_s‖_W before a reset, as tested by the trigger."""
    threshold: Reals
    """(k,) The value of ‖e_s‖_W above which there is an event."""
    e_c_norm: Reals
    """(k,) ‖e_c‖_W."""
    received: NDArray[np.int64]
    """(k,) sequence number of the controller's newest update at t, −1 for none."""

    def since_delivery(self, scenario: Scenario) -> NDArray[np.bool_]:
        """Return where the controller's error is recorded, from its first update on, (k,)."""
        known = scenario.network.initial_sync == "known_state"
        delivered = known | (self.received != NO_SEQUENCE)
        return np.asarray(np.isfinite(self.e_c_norm) & delivered)


class ControllerTrack(NamedTuple):
    """The controller's states in order; k states, n entries."""

    model_ns: Times
    """(k,) model times, ascending."""
    x_c: Reals
    """(k, n)"""
    received: NDArray[np.int64]
    """(k,) sequence number of the newest update in each state, −1 for none."""

    def since(self, index: int) -> "ControllerTrack":
        """Return the track from its ``index``-th state on."""
        return self._replace(
            model_ns=self.model_ns[index:], x_c=self.x_c[index:], received=self.received[index:]
        )


def shares_update(scenario: Scenario, aligned: AlignedRun) -> NDArray[np.bool_]:
    """Return where x_c is recorded, and sensor and controller share an update, (k,)."""
    recorded = all_entries(~np.isnan(aligned.x_c))
    return np.asarray(recorded & (aligned.received >= _first_shared(scenario)))


def _first_shared(scenario: Scenario) -> int:
    """The first update after which sensor and controller share one; −1 if x(0) is known to both."""
    return NO_SEQUENCE if scenario.network.initial_sync == "known_state" else 0


def initial_track(scenario: Scenario) -> ControllerTrack:
    """The controller's state before its first input."""
    loop = loop_of(scenario)
    known = scenario.network.initial_sync == "known_state"
    x_c = loop.known_x0 if known else np.zeros(loop.n)
    return ControllerTrack(np.zeros(1, np.int64), x_c[None, :], np.full(1, NO_SEQUENCE))


def controller_track(before: ControllerTrack, steps: Rows, deliveries: Rows) -> ControllerTrack:
    """Append ticks and deliveries to a track."""
    inputs = np.concatenate([steps["input"], deliveries["input"]])
    order = np.argsort(inputs, kind="stable")
    newest = np.concatenate([np.full(len(steps), NO_SEQUENCE), deliveries["sequence"]])[order]
    model_ns = np.concatenate([steps["model_t_ns"], deliveries["model_t_ns"]])[order]
    x_c = np.concatenate([steps["x_c"], deliveries["x_c"]]).take(order, axis=0)
    return ControllerTrack(
        np.concatenate([before.model_ns, model_ns]),
        np.concatenate([before.x_c, x_c]),
        np.maximum.accumulate(np.concatenate([before.received, newest])),
    )


@np.errstate(over="ignore", invalid="ignore")  # a run may diverge
def align_measurements(
    loop: LoopMatrices,
    measurements: Rows,
    track: ControllerTrack,
    until_ns: int,
    *,
    flow: ModelFlow | None = None,
    acknowledged: bool = False,
) -> AlignedRun:
    """Align measurements with the controller's track.

    Args:
        loop: matrices of the run.
        measurements: rows of ``sensor_measurement``, ordered.
        track: the controller's states, at least from the first measurement on.
        until_ns: end of the controller's track.
        flow: the flow of x_c; by default that of a run without changes of settings.
        acknowledged: updates are acknowledged: an event itself does not reset x_s. The reset by an
            acknowledged event appears in the next sample.
    """
    t_ns = measurements["t_ns"]
    reset = (measurements["event"] != NO_SEQUENCE) & (not acknowledged)
    x_s = measurements["x_s"].copy()
    x_s[reset] = measurements["x"][reset]
    flow = ModelFlow(loop.H, loop.reference) if flow is None else flow
    x_c, received = _controller_states_at(flow, track, t_ns, until_ns)
    e_c = x_c - measurements["x"]
    if loop.weight is not None:
        e_c = e_c @ loop.weight.T
    return AlignedRun(
        t_ns=t_ns,
        x=measurements["x"],
        x_s=x_s,
        x_c=x_c,
        x_norm=row_norms(measurements["x"]),
        e_s_norm=measurements["e_s_norm"],
        threshold=_threshold(measurements),
        e_c_norm=row_norms(e_c),
        received=received,
    )


def _threshold(measurements: Rows) -> Reals:
    """Return the value of ‖e_s‖_W at which both sides of the comparison would be equal.

    It assumes that the left side is proportional to ‖e_s‖_W. For a trigger that compares ‖e_s‖_W
    itself, like the paper's, this is its threshold.
    """
    left, right = measurements["compared"], measurements["threshold"]
    norms = measurements["e_s_norm"]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(left == norms, right, right * (norms / left)))


def _controller_states_at(
    flow: ModelFlow, track: ControllerTrack, t_ns: Times, until_ns: int
) -> tuple[Reals, NDArray[np.int64]]:
    """Return x_c, (k, n), and the number of its newest update, (k,), at k times."""
    index, known = _newest_states(track, t_ns, until_ns)
    received = np.where(known, track.received[index], NO_SEQUENCE)
    x_c = track.x_c.take(index, axis=0)
    x_c[~known] = np.nan
    dt_ns = t_ns - track.model_ns[index]
    if flow.reference is not None:
        for i in np.flatnonzero(known):
            state = int(index[i])
            x_c[i] = flow(track.x_c[state], int(track.model_ns[state]), int(t_ns[i]))
        return x_c, received
    older = np.flatnonzero(known & (dt_ns != 0))
    steps_ns = np.sort(dt_ns[older])  # few different ones; np.unique takes longer
    for step_ns in steps_ns[firsts_of_equal(steps_ns)].tolist():
        behind = older[dt_ns[older] == step_ns]
        set_rows(x_c, behind, flow.propagate.rows(x_c.take(behind, axis=0), step_ns))
    return x_c, received


def _newest_states(
    track: ControllerTrack, t_ns: Times, until_ns: int
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the index of the newest state at k times, (k,), and whether it is on record, (k,)."""
    index = np.searchsorted(track.model_ns, t_ns, side="right") - 1
    return index, (index >= 0) & (t_ns <= until_ns)


class PlantStates(NamedTuple):
    """The plant's own state at each of j steps of the plant."""

    t_ns: Times
    """(j,)"""
    x: Reals
    """(j, n)"""
    received: NDArray[np.int64]
    """(j,) sequence number of the controller's newest update at t, −1 for none."""
    shared: NDArray[np.bool_]
    """(j,) where the controller's state is on record, and shares an update with the sensor."""


class AlignedPart(NamedTuple):
    """Consecutive measurements, aligned, and the plant's steps up to the last of them."""

    rows: Rows
    """Their rows of ``sensor_measurement``, (k,)."""
    aligned: AlignedRun
    true_x: Reals | None
    """(k, n) the plant's own state, NaN where missing; None if the sensor measures it."""
    plant: PlantStates
    """All steps since the part before; in the last part, to the end of the run."""


def aligned_parts(record: RunRecord) -> Iterator[AlignedPart]:
    """Align a run part by part; a run without measurements has one empty part."""
    yield from _short_run(record) if record.is_short else _align(record)


@lru_cache(maxsize=1)
def _short_run(record: RunRecord) -> Sequence[AlignedPart]:
    """Return the parts of a run that is read several times in turn."""
    return tuple(_align(record))


def _align(record: RunRecord) -> Iterator[AlignedPart]:
    """Align measurements as soon as the controller's states up to their time are there."""
    scenario, loop, flow = record.scenario, record.loop, model_flow_of(record)
    acknowledged = scenario.protocol.acknowledges
    track = initial_track(scenario)
    waiting = np.zeros(0, record.tables[SENSOR_MEASUREMENT])
    steps = np.zeros(0, record.tables[PLANT_STEP])
    tables = (SENSOR_MEASUREMENT, CONTROLLER_STEP, CONTROLLER_DELIVERY, PLANT_STEP)
    first = _first_shared(scenario)

    def part(rows: Rows, plant: Rows, until_ns: int) -> AlignedPart:
        aligned = align_measurements(loop, rows, track, until_ns, flow=flow, acknowledged=acknowledged)
        true_x = None if scenario.coverage.knows_state else true_states(plant, rows["t_ns"])
        index, known = _newest_states(track, plant["t_ns"], until_ns)
        received = np.where(known, track.received[index], NO_SEQUENCE)
        states = PlantStates(plant["t_ns"], plant["x"], received, known & (received >= first))
        return AlignedPart(rows, aligned, true_x, states)

    for new_rows in record.slices(*tables):
        # A later state of the controller proves that all states up to a time are there.
        later = waiting["t_ns"] >= track.model_ns[-1]
        ready = int(np.argmax(later)) if later.any() else len(waiting)
        if ready:
            last_ns = waiting["t_ns"][ready - 1]
            passed = steps["t_ns"] <= last_ns
            yield part(waiting[:ready], steps.compress(passed), int(track.model_ns[-1]))
            keep = max(int(np.searchsorted(track.model_ns, last_ns, "right")) - 1, 0)
            track, steps = track.since(keep), steps.compress(~passed)
        waiting = concatenate_rows([waiting[ready:], new_rows[SENSOR_MEASUREMENT]], waiting.dtype)
        track = controller_track(track, new_rows[CONTROLLER_STEP], new_rows[CONTROLLER_DELIVERY])
        steps = concatenate_rows([steps, new_rows[PLANT_STEP]], steps.dtype)
    yield part(waiting, steps, int(track.model_ns[-1]) + scenario.timing.controller_period_ns)


def align_tables(record: RunRecord) -> AlignedRun:
    """Align a whole run; for a long run, see :func:`aligned_parts`."""
    parts = [part.aligned for part in aligned_parts(record)]
    return parts[0] if len(parts) == 1 else AlignedRun(*map(np.concatenate, zip(*parts, strict=True)))


class BoundedPart(NamedTuple):
    """An aligned part with bounds of the controller's error; k measurements."""

    part: AlignedPart
    is_bounded: NDArray[np.bool_]
    """(k,) where sensor and controller share an update, and ‖e_c‖ is finite: it is bounded there."""
    error_bounds: tuple[Reals, Reals]
    """Bounds of ‖e_c‖_W from (I1) and from eq:LossEv3, (k,) each; NaN where it is not bounded."""
    residual: Reals
    """Residual of (I1), (k,)."""


def bounded_parts(record: RunRecord) -> Iterator[BoundedPart]:
    """Yield the aligned parts with bounds of the controller's error, and (I1)'s residual.

    Summary and claims use those of a short run in turn.
    """
    yield from _short_bounds(record) if record.is_short else _add_bounds(record)


@lru_cache(maxsize=1)
def _short_bounds(record: RunRecord) -> Sequence[BoundedPart]:
    return tuple(_add_bounds(record))


def _add_bounds(record: RunRecord) -> Iterator[BoundedPart]:
    scenario = record.scenario
    shortest_ns = scenario.timing.measurement_period.lengths_ns[0]
    monitor = ErrorMonitor(record.loop.H, policy_of(scenario), shortest_ns)
    for part in aligned_parts(record):
        rows, aligned = part.rows, part.aligned
        e_s = rows["x_s"] - rows["x"]
        errors = monitor.take(rows["t_ns"], e_s, rows["event"], aligned.received)
        bounded = is_bounded(scenario, aligned)
        identity, printed = (np.where(bounded, bound, np.nan) for bound in (errors.identity, errors.printed))
        residual = identity_residual(scenario, aligned, errors.missed)
        yield BoundedPart(part, bounded, (identity, printed), residual)


def is_bounded(scenario: Scenario, aligned: AlignedRun) -> NDArray[np.bool_]:
    """Return where sensor and controller share an update, and ‖e_c‖ is finite, (k,)."""
    finite = np.isfinite(aligned.e_c_norm) & all_entries(np.isfinite(aligned.x_s))
    return np.asarray(finite & shares_update(scenario, aligned))


@np.errstate(over="ignore", invalid="ignore")
def identity_residual(scenario: Scenario, aligned: AlignedRun, missed: Reals) -> Reals:
    """Return max |x_c − x_s − missed| at k measurements, (k,): the residual of (I1).

    It is zero up to rounding on every run, for all losses.

    It is NaN if x_c is not recorded, and before the first delivery unless x(0) is known. In a run
    with acknowledgements all are NaN, since (I1) assumes that x_s is reset at every event.
    """
    if scenario.protocol.acknowledges or not len(aligned.t_ns):
        return np.full(len(aligned.t_ns), np.nan)
    residual = largest_sizes(aligned.x_c - aligned.x_s - missed)
    return np.where(shares_update(scenario, aligned), residual, np.nan)


def true_states(steps: Rows, t_ns: NDArray[np.int64], column: str = "x") -> Reals:
    """Return the plant's own state at some times, (k, n); NaN if its row is missing.

    ``column`` of ``plant_step`` is ``x``, or ``z`` for the whole state of a nonlinear plant.
    """
    states = np.full((len(t_ns), steps[column].shape[1]), np.nan)
    if len(steps):
        row = np.searchsorted(steps["t_ns"], t_ns).clip(max=len(steps) - 1)
        recorded = steps["t_ns"][row] == t_ns
        states[recorded] = steps[column][row[recorded]]
    return states
