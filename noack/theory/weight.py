"""Chooses the weight W of the trigger's norm for the tightest certificate.

If P = WᵀW and (H+αI)ᵀP + P(H+αI) ⪯ 0, ‖·‖_W contracts along the models. Then Δ ≤ M on a network
without delay. Among these factors W, the search finds the one with the longest certified
inter-event time: P solves the Lyapunov equation for some Q ⪰ 0, and Q is varied. W is scaled to
|det W| = 1, so that ‖W e‖ ≤ β encloses the same volume as ‖e‖ ≤ β.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from noack.config.resolution import LoopMatrices
from noack.core.linear_systems import Matrix, spectral_abscissa
from noack.theory.certificate import NetworkConditions, TriggerBound, VoidError, solve
from noack.theory.enclosure import NotDecayingError
from noack.theory.gains import ErrorGains, PlantGains

Indices = NDArray[np.int_]

_ROUNDS = 250
_MOST_FREE = 6


def choose_weight(
    loop: LoopMatrices,
    beta: float,
    alpha_per_s: float,
    longest_burst: int,
    progress: Callable[[float], None] = lambda share: None,
) -> Matrix:
    """Return W, upper triangular, (n, n), for a loop of any weight.

    ``longest_burst`` is the largest number of consecutive losses.

    ``progress`` receives the completed share of the work.

    Raises:
        NotDecayingError: α is not below the decay rate of e^{Ht} and e^{(A+BK)t}.
    """
    from scipy.optimize import minimize

    n = loop.n
    for name, matrix in (("the models", loop.H), ("A + BK", loop.A + loop.B @ loop.K)):
        if spectral_abscissa(matrix) + alpha_per_s >= 0:
            raise NotDecayingError(f"α = {alpha_per_s:g} /s is not below the decay rate of {name}")
    # Off-diagonal entries of Q are varied only for few states; for more they cost too much time.
    free = np.tril_indices(n) if n <= _MOST_FREE else np.diag_indices(n)
    rounds = 0

    def shortfall(entries: Matrix) -> float:
        nonlocal rounds
        rounds += 1
        progress(min(rounds / _ROUNDS, 1.0))
        weight = _weight(loop.H, alpha_per_s, free, entries)
        if weight is None:
            return 0.0
        error = ErrorGains(loop.H, loop.K, weight, alpha_per_s)
        plant = PlantGains(error, loop.A, loop.B, loop.x0[:, None], alpha_per_s)
        try:
            found = solve(error, plant, NetworkConditions(longest_burst), TriggerBound(beta, beta))
        except (VoidError, NotDecayingError):
            return 0.0
        return -(found.inter_event_s or 0.0)

    start = np.eye(n)[free]
    best = minimize(
        shortfall, start, method="Nelder-Mead", options={"maxfev": _ROUNDS, "adaptive": True}
    )
    progress(1.0)
    for entries in (best.x, start):
        weight = _weight(loop.H, alpha_per_s, free, entries)
        if weight is not None:
            return weight
    raise NotDecayingError("no Lyapunov function of the models was found")


def _weight(
    H: Matrix, alpha_per_s: float, free: tuple[Indices, ...], entries: Matrix
) -> Matrix | None:
    """Return W for Q = L Lᵀ from L's free entries; None if it fails the inequality by rounding."""
    from scipy.linalg import solve_continuous_lyapunov

    n = len(H)
    L = np.zeros((n, n))
    L[free] = entries
    Q = L @ L.T
    Q += 1e-6 * np.trace(Q) / n * np.eye(n)
    P = solve_continuous_lyapunov((H + alpha_per_s * np.eye(n)).T, -Q)
    try:
        weight = np.linalg.cholesky(0.5 * (P + P.T)).T
    except np.linalg.LinAlgError:
        return None
    scale = float(np.exp(np.linalg.slogdet(weight)[1] / n))
    found = np.asarray(weight / scale)
    return found if ErrorGains(H, np.zeros((1, n)), found, alpha_per_s).contracts else None
