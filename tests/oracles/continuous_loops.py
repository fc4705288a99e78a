"""Many runs of a loop in continuous time, compiled; independent of the project's code.

Between events z = (x, x_s, x_c) follows ż = Fz, from node to node of the grid by the matrix
exponential, and in a step with an event by its Taylor series; the event is found by bisection.
Values just before an event count, too.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from noack.core.linear_systems import Matrix, Vector
from noack.plants.systems.code_cache import cache_folder, compiler
from tests.oracles.lossy_loops import PART, STEPS, Flags, Reals, Steps, System

_ORDER = 16
_HALVINGS = 60
_COMPILED = compiler(cache_folder("tests_continuous", [Path(__file__)]))


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
    rows = np.cumsum([0, *(len(one) for one in signals)])
    largest, shortest_s = _follow(
        F, np.ascontiguousarray(expm(F * system.step_s)), np.vstack(signals), rows, delivered,
        np.tile(system.x0, 3), system.alpha, system.beta, system.step_s, STEPS,
    )  # fmt: skip
    return ContinuousTrace(*largest.T[..., None], float(shortest_s))


@PART
def _series(F: Matrix, z: Vector) -> Matrix:  # pragma: no cover
    """The coefficients of e^{Fs} z, (order + 1, 3n)."""
    found = np.empty((_ORDER + 1, len(z)))
    found[0] = z
    for k in range(1, _ORDER + 1):
        for i in range(len(z)):
            total = 0.0
            for j in range(len(z)):
                total += F[i, j] * found[k - 1, j]
            found[k, i] = total / k
    return found


@PART
def _at(series: Matrix, s: float) -> Vector:  # pragma: no cover
    found = series[_ORDER].copy()
    for k in range(_ORDER - 1, -1, -1):
        found = found * s + series[k]
    return found


@PART
def _size(signals: Matrix, first: int, last: int, z: Vector) -> float:  # pragma: no cover
    total = 0.0
    for row in range(first, last):
        value = 0.0
        for i in range(len(z)):
            value += signals[row, i] * z[i]
        total += value * value
    return np.sqrt(total)


@_COMPILED
def _follow(
    F: Matrix, leap: Matrix, signals: Matrix, rows: Steps, delivered: Flags, start: Vector,
    alpha: float, beta: float, step_s: float, steps: int,
) -> tuple[Matrix, float]:  # fmt: skip  # pragma: no cover
    runs, n, kinds = len(delivered), len(start) // 3, len(rows) - 1
    largest, shortest_s = np.zeros((runs, kinds)), np.inf
    for run in range(runs):
        z, events, last_s = start.copy(), 0, -np.inf
        now_s, ends_s = 0.0, step_s * steps
        grid_s, at_node = step_s, True
        while now_s < ends_s:
            left_s = grid_s - now_s
            after = leap @ z if at_node else _at(_series(F, z), left_s)
            crossed = _size(signals, rows[0], rows[1], after) * np.exp(alpha * grid_s) >= beta
            if crossed:
                series, low_s, high_s = _series(F, z), 0.0, left_s
                for _ in range(_HALVINGS):
                    middle_s = 0.5 * (low_s + high_s)
                    size = _size(signals, rows[0], rows[1], _at(series, middle_s))
                    if size * np.exp(alpha * (now_s + middle_s)) >= beta:
                        high_s = middle_s
                    else:
                        low_s = middle_s
                left_s = low_s
                after = _at(series, left_s)
            now_s = now_s + left_s if crossed else grid_s
            z, at_node = after, not crossed
            for kind in range(kinds):
                size = _size(signals, rows[kind], rows[kind + 1], z) * np.exp(alpha * now_s)
                largest[run, kind] = max(largest[run, kind], size)
            if not crossed:
                grid_s += step_s
                continue
            if events == delivered.shape[1]:
                break
            shortest_s = min(shortest_s, now_s - last_s)
            last_s = now_s
            z[n : 2 * n] = z[:n]
            if delivered[run, events]:
                z[2 * n :] = z[:n]
            events += 1
    return largest, shortest_s
