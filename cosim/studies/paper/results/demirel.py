"""Three loops on one channel under periodic schedules (Demirel, Aytekin, arXiv 2006.08015)."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

from cosim.studies.paper.published_result import ComparedValue, PublishedResult, stored_matrices, value_row
from noack.core.linear_systems import Matrix

_SOURCE = "authors' README.md"
_METHOD = (
    "stationary second moments of plant, filter and controller together over a period (a discrete "
    "Lyapunov equation), not the formula of the authors' program"
)
_DEVIATION = "the authors' formula gives 380.4944, too; the table's last digits differ"


class ScheduledLoop(NamedTuple):
    """x⁺ = Ax + Bu + w, y = Cx + v, and the cost xᵀQx + uᵀRu; W and V are covariances."""

    A: Matrix
    B: Matrix
    C: Matrix
    Q: Matrix
    R: Matrix
    W: Matrix
    V: Matrix

    @property
    def gain(self) -> Matrix:
        """L of u = −Lx̂."""
        S = solve_discrete_are(self.A, self.B, self.Q, self.R)
        weight = self.B.T @ S @ self.B + self.R
        return np.asarray(np.linalg.solve(weight, self.B.T @ S @ self.A))

    @property
    def filter_gain(self) -> Matrix:
        """Gain of the stationary Kalman filter at the sensor."""
        P = solve_discrete_are(self.A.T, self.C.T, self.W, self.V)
        return np.asarray(np.linalg.solve(self.C @ P @ self.C.T + self.V, self.C @ P).T)

    def mean_cost(self, sent: Sequence[bool]) -> float:
        """Return the mean cost per step if the estimate is sent at these steps of a period.

        The state is (x, x_f, x_c): plant, filtered estimate, the controller's estimate. After a
        step without transmission x_c follows the model; else it is x_f.
        """
        A, L, K, n = self.A, self.gain, self.filter_gain, len(self.A)
        BL, KC = self.B @ L, K @ self.C
        zero, no_gain = np.zeros((n, n)), np.zeros_like(K)
        free = np.block([[A, zero, -BL], [KC @ A, A - KC @ A, -BL], [zero, zero, A - BL]])
        plant, sensor = np.vstack([np.eye(n), KC, zero]), np.vstack([no_gain, K, no_gain])
        noise = plant @ self.W @ plant.T + sensor @ self.V @ sensor.T
        copy = np.eye(3 * n)
        copy[2 * n :] = copy[n : 2 * n]
        steps = [(copy @ free, copy @ noise @ copy.T) if is_sent else (free, noise) for is_sent in sent]
        period, added = np.eye(3 * n), np.zeros((3 * n, 3 * n))
        for step, drive in steps:
            period, added = step @ period, step @ added @ step.T + drive
        moments, total = solve_discrete_lyapunov(period, added), 0.0
        for step, drive in steps:
            moments = step @ moments @ step.T + drive
            inputs = L @ moments[2 * n :, 2 * n :] @ L.T
            total += float(np.trace(self.Q @ moments[:n, :n]) + np.trace(self.R @ inputs))
        return total / len(steps)


def drawn_loops(seed: int = 20) -> list[ScheduledLoop]:
    """Return the three plants that the authors' program draws, each with an unstable A, and two states."""
    random, n = np.random.RandomState(seed), 2  # as the authors' program

    def positive(size: int) -> Matrix:
        drawn = random.rand(size, size)
        return np.asarray((drawn + drawn.T) / 2 + size * np.eye(size))

    loops: list[ScheduledLoop] = []
    while len(loops) < 3:
        A = random.rand(n, n)
        while np.linalg.eigvals(A).real.max() < 1:
            A = random.rand(n, n)
        B, C = random.rand(n, 1), random.rand(1, n)
        loops.append(ScheduledLoop(A, B, C, positive(n), positive(1), positive(n), positive(1)))
    return loops


def _rows() -> list[ComparedValue]:
    drawn, rows = list(zip("123", drawn_loops(), strict=True)), []
    for schedule, published in stored_matrices("demirel")["losses"].items():
        turns = schedule.split(",")
        total = sum(loop.mean_cost([turn == name for turn in turns]) for name, loop in drawn)
        row = value_row(f"loss of {', '.join(turns)}", _SOURCE, float(published), total, _METHOD, digits=4)
        rows.append(row._replace(deviation=_DEVIATION if len(turns) == 7 else ""))
    return rows


RESULT = PublishedResult(
    about="losses of three LQG loops on one channel under periodic schedules",
    reference="Demirel, Aytekin, European Control Conference 2021, arXiv 2006.08015; authors' "
    "program: github.com/demirelbu/periodic-schedules",
    rows=_rows,
    notes=(
        "not available: the paper's text; the plants are those that the authors' program draws",
        "not run: links can have such slots (`schedule`), but plants of runs are in continuous "
        "time; this is the loss on an ideal channel",
    ),
)
