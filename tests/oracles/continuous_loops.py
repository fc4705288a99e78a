"""Many runs of a loop in continuous time; independent of the project's code.

Between events z = (x, x_s, x_c) follows ż = Fz, from node to node of the grid by the matrix
exponential, and in a step with an event by its Taylor series; the event is found by bisection.
Values just before an event count, too.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from tests.oracles.lossy_loops import STEPS, Flags, Reals, Steps, System, norms

_ORDER = 16
_HALVINGS = 50


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


def simulate_continuous_time(system: System, delivered: Flags, _: Steps) -> ContinuousTrace:
    """Simulate the outcomes (runs, events) of the updates; a run ends when it has no more."""
    n, A, H = len(system.A), system.A, system.H
    BK, none = system.B @ system.K, np.zeros((n, n))
    F = np.block([[A, none, BK], [none, H, none], [none, none, H]])
    W, eye = system.weight, np.eye(n)
    E = A + BK - H
    signals = [
        W @ np.hstack([-eye, eye, none]),
        W @ np.hstack([-eye, none, eye]),
        np.hstack([eye, none, none]),
        W @ np.hstack([eye, none, none]),
        system.K @ np.hstack([-eye, none, eye]),
        W @ E @ np.hstack([eye, none, none]),
    ]
    leap, step_s = expm(F * system.step_s).T, system.step_s
    z, events = np.tile(system.x0, (len(delivered), 3)), np.zeros(len(delivered), dtype=np.int64)
    largest, last_s = np.zeros((len(signals), len(z))), np.full(len(z), -np.inf)
    shortest_s = np.inf
    running = np.arange(len(z))

    def grown(z: Reals, t_s: Reals | float, signal: Reals) -> Reals:
        return np.asarray(norms(z @ signal.T) * np.exp(system.alpha * t_s))

    def note(which: Steps, z: Reals, t_s: Reals | float) -> None:
        for kind, signal in enumerate(signals):
            largest[kind, which] = np.maximum(largest[kind, which], grown(z, t_s, signal))

    for step in range(STEPS):
        following, end_s = z @ leap, (step + 1) * step_s
        begin_s = np.full(len(z), step * step_s)
        crossing = running[grown(following[running], end_s, signals[0]) >= system.beta]
        while len(crossing):
            series, low_s = _series(F, z[crossing]), np.zeros(len(crossing))
            high_s = end_s - begin_s[crossing]
            for _ in range(_HALVINGS):
                middle_s = (low_s + high_s) / 2
                t_s = begin_s[crossing] + middle_s
                above = grown(_at(series, middle_s), t_s, signals[0]) >= system.beta
                low_s, high_s = np.where(above, low_s, middle_s), np.where(above, middle_s, high_s)
            now_s = begin_s[crossing] + low_s
            begin_s[crossing], before = now_s, _at(series, low_s)
            note(crossing, before, now_s)
            z[crossing] = before
            more = events[crossing] < delivered.shape[1]
            running = np.setdiff1d(running, crossing[~more])
            crossing, now_s = crossing[more], now_s[more]
            shortest_s = min(shortest_s, (now_s - last_s[crossing]).min(initial=np.inf))
            last_s[crossing] = now_s
            z[crossing, n : 2 * n] = z[crossing, :n]
            received = crossing[delivered[crossing, events[crossing]]]
            z[received, 2 * n :] = z[received, :n]
            events[crossing] += 1
            following[crossing] = _at(_series(F, z[crossing]), end_s - now_s)
            above = grown(following[crossing], end_s, signals[0]) >= system.beta
            crossing = crossing[above]
        note(running, following[running], end_s)
        z = following
    return ContinuousTrace(*largest[..., None], float(shortest_s))


def _series(F: Reals, z: Reals) -> Reals:
    """The coefficients of e^{Fs} z, (order + 1, runs, 3n)."""
    found = [z]
    for k in range(1, _ORDER + 1):
        found.append(found[-1] @ F.T / k)
    return np.array(found)


def _at(series: Reals, s: Reals) -> Reals:
    found = series[-1]
    for coefficients in series[-2::-1]:
        found = found * s[:, None] + coefficients
    return found
