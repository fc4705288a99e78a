"""Many runs of a loop in continuous time; independent of the project's code.

Between events z = (x, x_s, x_c) follows ż = Fz, from node to node of the grid by the matrix
exponential, and in a step with an event by its Taylor series; the event is found by dividing the
step again and again. Values just before an event count, too.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from tests.oracles.lossy_loops import STEPS, Flags, Reals, Steps, System, norms

_ORDER = 16
_PARTS, _DIVISIONS = 16, 12


class ContinuousTrace(NamedTuple):
    """The largest e^(αt) ‖·‖ of every run, (runs, 1), and the shortest inter-event time of all."""

    sensor_error: Reals
    """‖e_s‖_W"""
    controller_error: Reals
    """‖e_c‖_W"""
    state: Reals
    state_weighted: Reals
    input_error: Reals
    mismatch: Reals
    """‖E x‖_W with E = A + BK − H."""
    inter_event_s: float
    error_at_events: Reals
    """e^(αt) ‖e_c‖_W just before each event, (runs, events); 0 without an event."""


def simulate_continuous_time(system: System, delivered: Flags, _: Steps) -> ContinuousTrace:
    """Simulate the outcomes (runs, events) of the updates; a run ends when it has no more."""
    # z = (x, x_s, x_c) with dz/dt = F z between events, and what is measured of it.
    n, A, H = len(system.A), system.A, system.H
    BK, zero = system.B @ system.K, np.zeros((n, n))
    F = np.block([[A, zero, BK], [zero, H, zero], [zero, zero, H]])
    W, eye = system.weight, np.eye(n)
    E = A + BK - H
    signals = [
        W @ np.hstack([-eye, eye, zero]),
        W @ np.hstack([-eye, zero, eye]),
        np.hstack([eye, zero, zero]),
        W @ np.hstack([eye, zero, zero]),
        system.K @ np.hstack([-eye, zero, eye]),
        W @ E @ np.hstack([eye, zero, zero]),
    ]
    e_s = signals[0].T
    rows, begins = np.vstack(signals).T, np.cumsum([0, *(len(signal) for signal in signals[:-1])])
    # A run is a row of each array; ``running`` are those that have outcomes left.
    leap, step_s = expm(F * system.step_s).T, system.step_s
    z, events = np.tile(system.x0, (len(delivered), 3)), np.zeros(len(delivered), dtype=np.int64)
    largest, last_s = np.zeros((len(z), len(signals))), np.full(len(z), -np.inf)
    shortest_s, running = np.inf, np.arange(len(z))
    at_events = np.zeros(delivered.shape)

    def is_above(error: Reals, t_s: Reals | float) -> Flags:
        return np.asarray(norms(error) * np.exp(system.alpha * t_s) >= system.beta)

    def note(which: Steps, t_s: Reals | float) -> None:
        """Take the state of these runs into account."""
        sizes = np.sqrt(np.add.reduceat((z[which] @ rows) ** 2, begins, axis=1))
        grown = (sizes.T * np.exp(system.alpha * t_s)).T
        largest[which] = np.maximum(largest[which], grown)

    for step in range(STEPS):
        # Propagate over a step; runs whose error is above the threshold at its end have an event in it.
        following, end_s = z @ leap, (step + 1) * step_s
        begin_s = np.full(len(z), step * step_s)
        crossing = running[is_above(following[running] @ e_s, end_s)]
        while len(crossing):
            # Find the event times: the first part in which the error crosses, divided again and again.
            series, low_s = _series(F, z[crossing]), np.zeros(len(crossing))
            errors = series @ e_s
            width_s = end_s - begin_s[crossing]
            for _ in range(_DIVISIONS):
                width_s = width_s / _PARTS
                ends_s = low_s + width_s * np.arange(1, _PARTS + 1)[:, None]
                above = is_above(_at(errors, ends_s), begin_s[crossing] + ends_s)
                low_s = low_s + width_s * np.argmax(above, axis=0)
            now_s = begin_s[crossing] + low_s
            z[crossing], begin_s[crossing] = _at(series, low_s[None])[0], now_s
            note(crossing, now_s)
            # A run without further outcomes ends at its event.
            more = events[crossing] < delivered.shape[1]
            running = np.setdiff1d(running, crossing[~more])
            crossing, now_s = crossing[more], now_s[more]
            shortest_s = min(shortest_s, (now_s - last_s[crossing]).min(initial=np.inf))
            last_s[crossing] = now_s
            e_c = norms(z[crossing] @ signals[1].T)
            at_events[crossing, events[crossing]] = e_c * np.exp(system.alpha * now_s)
            # Reset x_s, and x_c where the update is delivered; go on to the end of the step.
            z[crossing, n : 2 * n] = z[crossing, :n]
            received = crossing[delivered[crossing, events[crossing]]]
            z[received, 2 * n :] = z[received, :n]
            events[crossing] += 1
            following[crossing] = _at(_series(F, z[crossing]), (end_s - now_s)[None])[0]
            crossing = crossing[is_above(following[crossing] @ e_s, end_s)]
        z = following
        note(running, end_s)
    return ContinuousTrace(*largest.T[..., None], float(shortest_s), at_events)


def _series(F: Reals, z: Reals) -> Reals:
    """The coefficients of e^{Fs} z, (order + 1, runs, 3n)."""
    coefficients = [z]
    for k in range(1, _ORDER + 1):
        coefficients.append(coefficients[-1] @ F.T / k)
    return np.array(coefficients)


def _at(series: Reals, s: Reals) -> Reals:
    """The values at times (k, runs), as (k, runs, 3n)."""
    values = np.broadcast_to(series[-1], (*s.shape, series.shape[2]))
    for coefficients in series[-2::-1]:
        values = values * s[..., None] + coefficients
    return values
