"""The switching event trigger (Selivanov, Fridman, 2016): its linear matrix inequalities, and runs.

That inequalities have a solution is shown by a solution, in ``selivanov_fridman.toml``: a matrix is
positive definite if it is after scaling its diagonal to 1, by more than rounding can change. The
solutions were computed by an SDP solver; whoever checks them needs none. Names are the paper's.
"""

import math
from collections.abc import Mapping

import numpy as np

from cosim.simulation.continuous import ContinuousLoop
from cosim.studies.paper.published_result import (
    ComparedValue,
    PublishedResult,
    run_from_each,
    shipped_loop,
    stored_matrices,
    unit_states,
)
from noack.core.linear_systems import Matrix

Blocks = Mapping[tuple[int, int], Matrix]
"""The upper triangle of a symmetric matrix, by block row and column from 1 on."""
Solution = Mapping[str, Matrix]

_MARGIN = 1e-9
"""Smallest eigenvalue, after scaling, that counts as positive."""
_SOURCE = "authors' test.m"
_LMI = (
    "the publication says that the LMIs are feasible; the smallest scaled eigenvalue of all "
    "matrices of a stored solution shows it. Theorem 1, Remark 1: δ = 0.24. Theorem 2, Remark 3: "
    "γ = 100, delays up to 0.1 s"
)
_RUN = (
    "exact runs in continuous time from states on a circle: the largest V(t_k)e^(2δt_k)/V(0) of "
    "all transmissions, V = xᵀPx"
)
_TRANSMISSIONS_METHOD = "of the same runs, the mean number of transmissions in 20 s: {:.2f}, {:.2f}"
DELTA, GAMMA, DELAY_S = 0.24, 100.0, 0.1
"""Decay rate of Example 1; gain and largest delay of Example 2."""
_SWITCHING, _PERIODIC = (0.899, 0.554), (1.115, 0.0046)
"""h in seconds and ε of Example 1: Theorem 1, and the periodic event trigger of Remark 1."""


def smallest_eigenvalue(matrix: Matrix) -> float:
    """Return that of a symmetric matrix, scaled to a diagonal of 1; −1 if this is impossible."""
    diagonal = np.diag(matrix)
    if (diagonal <= 0).any():
        return -1.0
    return float(np.linalg.eigvalsh(matrix / np.sqrt(np.outer(diagonal, diagonal)))[0])


def symmetric(blocks: Blocks) -> Matrix:
    """Return the matrix of these blocks; blocks that are not given are 0."""
    ends = np.cumsum([0, *(len(blocks[i, i]) for i in range(1, 1 + max(i for i, _ in blocks)))])
    matrix = np.zeros((ends[-1], ends[-1]))
    for (i, j), block in blocks.items():
        rows, columns = slice(ends[i - 1], ends[i]), slice(ends[j - 1], ends[j])
        matrix[rows, columns], matrix[columns, rows] = block, block.T
    return matrix


def output_feedback(solution: Solution, h: float, epsilon: float, *, waits: bool) -> list[Matrix]:
    """Return what must be positive for Example 1: Theorem 1 if the sensor waits, else Remark 1."""
    A, C, BK, d = np.array([[0, 1], [0, -3.0]]), np.array([[1.0, 0]]), np.array([[0], [3.0]]), DELTA
    P, U, X, X1, P2, P3 = (solution[name] for name in ("P", "U", "X", "X1", "P2", "P3"))
    Y1, Y2, Y3, omega = (solution[name] for name in ("Y1", "Y2", "Y3", "Omega"))
    symmetric_X, event, closed = X + X.T, epsilon * C.T @ omega @ C, A - BK @ C
    first = A.T @ P2 + P2.T @ A + 2 * d * P - Y1 - Y1.T + (0 if waits else event)
    second, corner = P - P2.T + A.T @ P3 - Y2, symmetric_X - 2 * X1 - 2 * X1.T
    cross, tail = Y1.T - P2.T @ BK @ C - Y3, Y2.T - P3.T @ BK @ C
    start = {(1, 1): first - (0.5 - d * h) * symmetric_X, (1, 2): second + h * symmetric_X / 2}
    start |= {(1, 3): cross + (1 - 2 * d * h) * (X - X1), (2, 2): h * U - P3 - P3.T}
    start |= {(2, 3): tail - h * (X - X1), (3, 3): Y3 + Y3.T - (0.5 - d * h) * corner}
    end = {(1, 1): first - symmetric_X / 2, (1, 2): second, (1, 3): cross + X - X1, (1, 4): h * Y1.T}
    end |= {(2, 2): -P3 - P3.T, (2, 3): tail, (2, 4): h * Y2.T, (3, 4): h * Y3.T}
    end |= {(3, 3): Y3 + Y3.T - corner / 2, (4, 4): -h * math.exp(-2 * d * h) * U}
    functional = {(1, 1): P + h * symmetric_X / 2, (1, 2): h * (X1 - X), (2, 2): h * corner / 2}
    positive = [P, U, omega, symmetric(functional)]
    if not waits:  # the error acts all the time
        start |= {(1, 4): -P2.T @ BK, (2, 4): -P3.T @ BK, (4, 4): -omega}
        end |= {(1, 5): -P2.T @ BK, (2, 5): -P3.T @ BK, (5, 5): -omega}
        return [*positive, -symmetric(start), -symmetric(end)]
    event_phase = {(1, 1): P2.T @ closed + closed.T @ P2 + event + 2 * d * P, (1, 3): -P2.T @ BK}
    event_phase |= {(1, 2): P + closed.T @ P3 - P2.T, (2, 2): -P3 - P3.T, (2, 3): -P3.T @ BK}
    event_phase |= {(3, 3): -omega}
    return [*positive, -symmetric(start), -symmetric(end), -symmetric(event_phase)]


def cart_pole(solution: Solution, h: float, epsilon: float, *, waits: bool) -> list[Matrix]:
    """Return what must be positive for Example 2: Theorem 2 if the sensor waits, else Remark 3."""
    A = np.array([[0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1], [0, 0, 10 / 3, 0]])
    B1, B2, C1 = np.ones((4, 1)), np.array([[0], [0.1], [0], [-1 / 30]]), np.ones((1, 4))
    K = np.array([[2.9129, 10.4357, 287.9029, 160.3271]])
    P, S0, S1, R0, R1 = (solution[name] for name in ("P", "S0", "S1", "R0", "R1"))
    omega, G0, G1 = (solution[name] for name in ("Omega", "G0", "G1"))
    H, BK, DK, limit = DELAY_S**2 * R0 + h**2 * R1, B2 @ K, 0.1 * K, -(GAMMA**2) * np.eye(1)
    first, through = A.T @ P + P @ A + S0 - R0 + C1.T @ C1, P @ BK + C1.T @ DK
    shared = {(1, 1): first, (2, 2): S1 - S0 - R0 - R1, (3, 3): -R1 - S1}
    event = {(1, 5): through, (1, 6): P @ B1, (1, 7): A.T @ H, (4, 5): DK.T @ DK, (7, 7): -H}
    event |= {(5, 5): DK.T @ DK - omega, (4, 7): BK.T @ H, (5, 7): BK.T @ H, (6, 7): B1.T @ H}
    event |= {(6, 6): limit}
    quiet = {(1, 5): P @ B1, (1, 6): A.T @ H, (4, 6): BK.T @ H, (5, 5): limit}
    quiet |= {(5, 6): B1.T @ H, (6, 6): -H}
    late = {(1, 2): R0, (1, 4): through, (2, 3): G1, (2, 4): R1 - G1, (3, 4): R1 - G1.T}
    late[4, 4] = G1 + G1.T - 2 * R1 + DK.T @ DK + (0 if waits else epsilon * omega)
    early = {(1, 2): G0, (1, 4): through + R0 - G0, (2, 3): R1, (2, 4): R0 - G0.T}
    early[4, 4] = G0 + G0.T - 2 * R0 + DK.T @ DK + epsilon * omega
    convex = [symmetric({(1, 1): R, (1, 2): G, (2, 2): R}) for R, G in ((R0, G0), (R1, G1))]
    negative = [shared | late | (quiet if waits else event), shared | early | event]
    return [P, S0, S1, R0, R1, omega, *convex, *(-symmetric(blocks) for blocks in negative)]


INEQUALITIES = {
    "Theorem 1": (output_feedback, *_SWITCHING, True),
    "Remark 1": (output_feedback, *_PERIODIC, False),
    "Theorem 2": (cart_pole, 0.065, 0.044, True),
    "Remark 3": (cart_pole, 0.036, 0.033, False),
}
"""By statement: the inequalities, h in seconds, ε, whether the sensor waits."""


def _rows() -> list[ComparedValue]:
    rows, solutions = [], stored_matrices("selivanov_fridman")
    for statement, (inequalities, h, epsilon, waits) in INEQUALITIES.items():
        parts = inequalities(solutions[statement], h, epsilon, waits=waits)
        margin = min(map(smallest_eigenvalue, parts))
        quantity = f"{statement}, h = {h}, ε = {epsilon}"
        rows.append(ComparedValue(quantity, _SOURCE, ">", "0", f"{margin:.1e}", _LMI, margin > _MARGIN))
    loops = (("switching", "Theorem 1", _switching()), ("periodic", "Remark 1", _periodic()))
    means = []
    for name, statement, loop in loops:
        growth, mean = _growth_and_transmissions(loop, solutions[statement]["P"], unit_states(100, 2))
        means.append(mean)
        quantity, source = f"growth of V, {name}", f"follows from {statement}"
        rows.append(ComparedValue(quantity, source, "≤", "1", f"{growth:.3f}", _RUN, growth <= 1))
    share = means[0] / means[1]
    quantity, method = "transmissions, switching / periodic", _TRANSMISSIONS_METHOD.format(*means)
    return [*rows, ComparedValue(quantity, "abstract", "<", "1", f"{share:.3f}", method, share < 1)]


def _switching() -> ContinuousLoop:
    """Return the loop of Theorem 1: after the waiting time the trigger is tested at all times."""
    loop = shipped_loop("selivanov_switching")
    return ContinuousLoop(loop.loop, loop.trigger._replace(grid_ns=0.0))


def _periodic() -> ContinuousLoop:
    """Return the loop of Remark 1: the trigger is tested at multiples of h."""
    h, epsilon = _PERIODIC
    Q = f"[[{-epsilon}, 0, 0, 0], [0, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 0]]"
    trigger = f'trigger={{policy="quadratic", period_s={h}, Q={Q}}}'
    return shipped_loop("selivanov_switching", [trigger, "plant.rate_hz=200"])


def _growth_and_transmissions(loop: ContinuousLoop, P: Matrix, x0: Matrix) -> tuple[float, float]:
    """Return the largest V(t_k) e^(2δt_k) / V(0) of all runs, and the mean number of transmissions.

    At a transmission the paper's functional V is xᵀPx. The one at t = 0 counts.
    """
    log = run_from_each(loop, x0, 20.0, most_events=100)
    assert log.states is not None
    has_event = ~np.isnan(log.event_s)
    x, t_s = log.states[:, :, 0][has_event], log.event_s[has_event]
    starts = np.repeat(x0, has_event.sum(axis=1), axis=0)
    energies, at_start = (np.einsum("ki,ij,kj->k", states, P, states) for states in (x, starts))
    growth = energies * np.exp(2 * DELTA * t_s) / at_start
    return float(growth.max()), 1 + len(t_s) / len(x0)


RESULT = PublishedResult(
    about="stability of the switching event trigger, and how much it sends",
    reference="Selivanov, Fridman, Event-Triggered H-infinity Control: a Switching Approach, IEEE "
    "TAC 61(10), 2016, arXiv 1506.01587; authors' program: github.com/AntonSelivanov/TAC16",
    rows=_rows,
    notes=(
        "not available: the paper's text, so its own numbers of sent measurements and its runs "
        "are not compared",
        "not shown: that no larger h or ε is feasible; noack certify has no bound for this trigger",
    ),
)
