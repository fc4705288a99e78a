"""Joins the tables of a run on the measurements' time grid.

Nobody in the loop sees x, x_s and x_c together; the record does. At each measurement time t:

* x(t) and x_s(t) are the sensor's own; at an event x_s is shown after its reset,
* x_c(t) is the controller's last state whose model time is at most t, propagated by e^{H(t−t')}.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.record import Rows, RunRecord
from noack.linear import Matrix, Propagator
from noack.records import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    NO_SEQUENCE,
    SENSOR_MEASUREMENT,
)
from noack.resolve import Loop, loop_of
from noack.scenario import Scenario
from noack.theory.identities import MissedJumps

Times = NDArray[np.int64]
Reals = NDArray[np.float64]


class Joined(NamedTuple):
    """Samples on the measurement grid; k samples, n states."""

    t_ns: Times
    """(k,)"""
    x: Reals
    """(k, n)"""
    x_s: Reals
    """(k, n), after a reset."""
    x_c: Reals
    """(k, n); NaN where the controller's record does not reach."""
    e_s_norm: Reals
    """(k,) ‖e_s‖_W before a reset: what the trigger tested."""
    threshold: Reals
    """(k,) What ‖e_s‖_W would have to exceed for an event."""
    e_c_norm: Reals
    """(k,) ‖e_c‖_W."""
    received: NDArray[np.int64]
    """(k,) sequence number of the controller's newest update at t, −1 for none."""


class ControllerTrack(NamedTuple):
    """The controller's states in the order in which it went through them."""

    model_ns: Times
    x_c: Reals
    received: NDArray[np.int64]

    def since(self, index: int) -> "ControllerTrack":
        """The track from its ``index``-th state on."""
        return ControllerTrack(self.model_ns[index:], self.x_c[index:], self.received[index:])


def in_common(scenario: Scenario, joined: Joined) -> NDArray[np.bool_]:
    """Where x_c is on record, and sensor and controller have something in common, (k,)."""
    known = scenario.network.initial_sync == "known_state"
    common = known | (joined.received != NO_SEQUENCE)
    return np.asarray(~np.isnan(joined.x_c).any(axis=1) & common)


def initial_track(scenario: Scenario) -> ControllerTrack:
    """The controller's state before its first input."""
    loop = loop_of(scenario)
    known = scenario.network.initial_sync == "known_state"
    x_c = loop.x0 if known else np.zeros(loop.n)
    return ControllerTrack(np.zeros(1, np.int64), x_c[None, :], np.full(1, NO_SEQUENCE))


def controller_track(before: ControllerTrack, steps: Rows, deliveries: Rows) -> ControllerTrack:
    """Continue a track by ticks and deliveries."""
    order = np.argsort(np.concatenate([steps["input"], deliveries["input"]]), kind="stable")
    newest = np.concatenate([np.full(len(steps), NO_SEQUENCE), deliveries["sequence"]])[order]
    return ControllerTrack(
        np.concatenate(
            [
                before.model_ns,
                np.concatenate([steps["model_t_ns"], deliveries["model_t_ns"]])[order],
            ]
        ),
        np.concatenate([before.x_c, np.concatenate([steps["x_c"], deliveries["x_c"]])[order]]),
        np.maximum.accumulate(np.concatenate([before.received, newest])),
    )


@np.errstate(over="ignore", invalid="ignore")  # a run may diverge
def join(
    loop: Loop,
    measurements: Rows,
    track: ControllerTrack,
    until_ns: int,
    *,
    acknowledged: bool = False,
) -> Joined:
    """Join measurements with the controller's track.

    Args:
        loop: matrices of the run.
        measurements: rows of ``sensor_measurement``, ordered.
        track: the controller's states, at least from the first measurement on.
        until_ns: x_c is known up to here.
        acknowledged: an event does not reset x_s; it shows in the next sample if one did that was
            acknowledged.
    """
    t_ns = measurements["t_ns"]
    reset = (measurements["event"] != NO_SEQUENCE) & (not acknowledged)
    x_s = np.where(reset[:, None], measurements["x"], measurements["x_s"])
    x_c, received = _at(loop.H, track, t_ns, until_ns)
    e_c = x_c - measurements["x"]
    if loop.weight is not None:
        e_c = e_c @ loop.weight.T
    return Joined(
        t_ns,
        measurements["x"],
        x_s,
        x_c,
        measurements["e_s_norm"],
        _threshold(measurements),
        np.linalg.norm(e_c, axis=1),
        received,
    )


def _threshold(measurements: Rows) -> Reals:
    """Where ‖e_s‖_W would be an event, if the sides of the comparison grew with it alike.

    For a trigger that compares ‖e_s‖_W itself, as the paper's does, this is its threshold.
    """
    left, right = measurements["compared"], measurements["threshold"]
    norms = measurements["e_s_norm"]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(left == norms, right, right * (norms / left)))


def _at(
    H: Matrix, track: ControllerTrack, t_ns: Times, until_ns: int
) -> tuple[Reals, NDArray[np.int64]]:
    x_c = np.full((len(t_ns), H.shape[0]), np.nan)
    received = np.full(len(t_ns), NO_SEQUENCE, dtype=np.int64)
    index = np.searchsorted(track.model_ns, t_ns, side="right") - 1
    known = (index >= 0) & (t_ns <= until_ns)
    received[known] = track.received[index[known]]
    dt_ns = t_ns - track.model_ns[index]
    propagate = Propagator(H)
    for step_ns in np.unique(dt_ns[known]):
        which = known & (dt_ns == step_ns)
        states = track.x_c[index[which]]
        x_c[which] = states @ propagate.transition(int(step_ns)).T if step_ns else states
    return x_c, received


def join_all(record: RunRecord) -> Joined:
    """Join a whole run."""
    steps = record[CONTROLLER_STEP]
    track = controller_track(initial_track(record.scenario), steps, record[CONTROLLER_DELIVERY])
    reach_ns = int(track.model_ns[-1]) + record.scenario.controller_period_ns
    acknowledged = record.scenario.is_acknowledged
    return join(record.loop, record[SENSOR_MEASUREMENT], track, reach_ns, acknowledged=acknowledged)


def identity_residual(record: RunRecord, joined: Joined) -> Reals:
    """Largest entry of |x_c − x_s − Σ e^{H(t−t_k)} e_s(t_k⁻)| at each measurement, (k,): (I1).

    Zero to rounding on every run, whatever was lost. NaN where x_c is not recorded, and as long as
    sensor and controller have nothing in common: before the first delivery, unless x(0) is known.
    NaN throughout where updates are acknowledged: it presupposes that x_s is reset at every event.
    """
    if record.scenario.is_acknowledged:
        return np.full(len(joined.t_ns), np.nan)
    measurements = record[SENSOR_MEASUREMENT]
    known = record.scenario.network.initial_sync == "known_state"
    missed = MissedJumps(record.loop.H)
    residual = np.full(len(joined.t_ns), np.nan)
    for i, row in enumerate(measurements):
        missed.advance_to(int(row["t_ns"]))
        if row["event"] != NO_SEQUENCE:
            missed.event(int(row["event"]), row["x_s"] - row["x"])
        missed.received(int(joined.received[i]))
        if known or joined.received[i] != NO_SEQUENCE:
            residual[i] = np.max(np.abs(joined.x_c[i] - joined.x_s[i] - missed.total()))
    return residual
