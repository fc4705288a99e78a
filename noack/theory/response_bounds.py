"""Responses C e^{Mt} Y of a linear system: the largest norm and the integral of the norm, enclosed.

The enclosures are those of :mod:`noack_gains.responses`.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_continuous_lyapunov

from noack.core.balls import matrix, number
from noack.core.linear_systems import Matrix
from noack_gains import RejectedError
from noack_gains.responses import Decay, responses


class NotDecayingError(ArithmeticError):
    """A response does not decay, or too slowly to be enclosed."""


class ResponseBound(NamedTuple):
    """Upper bounds of sup ‖C e^{Mt} Y‖ and of ∫ ‖C e^{Mt} Y‖ dt over t ≥ 0."""

    largest: float
    integral: float


def lyapunov_decay(M: Matrix, rate: float = 0.0) -> tuple[Matrix, float]:
    """Return P and ν with (M + r)ᵀP + P(M + r) ⪯ −2νP, about half of what is possible.

    Raises:
        NotDecayingError: M + r does not decay.
    """
    G = M + rate * np.eye(len(M))
    decay = -0.5 * float(np.linalg.eigvals(G).real.max())
    if not decay > 0:
        raise NotDecayingError(f"it does not decay at {rate:.3g}/s")
    P = solve_continuous_lyapunov((G + decay * np.eye(len(G))).T, -np.eye(len(G)))
    P = (P + P.T) / 2
    return P / np.abs(P).max(), decay * (1 - 1e-9)


def bound_response(M: Matrix, C: Matrix, Y: NDArray[np.floating]) -> ResponseBound:
    """Return bounds of C e^{Mt} Y, M (n, n), C (q, n), Y (n, k).

    Raises:
        NotDecayingError: it does not decay, or too slowly.
    """
    P, rate = lyapunov_decay(M)
    generator, decay = matrix(M.tolist()), Decay(matrix(P.tolist()), number(rate))
    try:
        decay.require(generator, "the response")
        ((found,),) = responses(generator, decay, [matrix(C.tolist())], [matrix(Y.tolist())])
    except RejectedError as error:
        raise NotDecayingError(str(error)) from None
    return ResponseBound(float(found.most.upper()), float(found.total.upper()))
