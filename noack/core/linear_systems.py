"""Linear time-invariant systems: exact propagation, exact zero-order hold, norms.

Time steps are integer nanoseconds; matrices are per second. The same step always gives the same
matrix, bit for bit, whether it was cached or not, and on every processor.
"""

from collections.abc import Iterable
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from noack.core.matrix_exponential import exponential
from noack.core.ordered_arithmetic import norm_of, product

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

_CACHED_STEPS = 4096
_SAFE = 1e-140
"""Squares of vectors between this size and its inverse neither underflow nor overflow."""


def transition(generator: Matrix, dt_ns: int) -> Matrix:
    """Return the transition matrix e^{G dt}, shape (n, n), of ``dz/dt = G z`` over ``dt_ns``."""
    return exponential(generator * (dt_ns * 1e-9))


def discretise(A: Matrix, B: Matrix, dt_ns: int) -> tuple[Matrix, Matrix]:
    """Return the exact discretisation of ``dx/dt = A x + B u`` with u held over ``dt_ns``.

    Both blocks come from one exponential, e^{[[A, B], [0, 0]] dt} (Van Loan, 1978), so A may be
    singular.

    Returns:
        ``(Ad, Bd)`` of shapes (n, n) and (n, m) with ``x(t + dt) = Ad x(t) + Bd u``.
    """
    n, m = B.shape
    generator = np.zeros((n + m, n + m))
    generator[:n, :n] = A
    generator[:n, n:] = B
    both = transition(generator, dt_ns)
    return np.ascontiguousarray(both[:n, :n]), np.ascontiguousarray(both[:n, n:])


class Propagator:
    """Advances states of the autonomous system ``dz/dt = G z`` exactly; G is (n, n), per second.

    Transition matrices are cached by step; a loop on a time grid has few distinct steps. The
    matrices of ``steps_ns`` are computed at once, so that the first deadlines are not delayed.
    """

    def __init__(self, generator: Matrix, steps_ns: Iterable[int] = ()) -> None:
        self.generator = np.array(generator, dtype=np.float64)
        self._static = not self.generator.any()
        self.transition = lru_cache(_CACHED_STEPS)(partial(transition, self.generator))
        for step_ns in steps_ns:
            self.transition(step_ns)

    def __call__(self, state: Vector, dt_ns: int) -> Vector:
        """Return e^{G dt} ``state``, shape (n,)."""
        if dt_ns == 0 or self._static:
            return state
        return product(self.transition(dt_ns), state)

    def rows(self, states: Matrix, dt_ns: int) -> Matrix:
        """Return e^{G dt} of each of k states, shape (k, n)."""
        if dt_ns == 0 or self._static:
            return states
        return np.asarray(states @ self.transition(dt_ns).T)


class HeldInputPropagator:
    """Advances ``dx/dt = A x + B u`` exactly under a held input (:func:`discretise`)."""

    def __init__(self, A: Matrix, B: Matrix) -> None:
        self.A = np.array(A, dtype=np.float64)
        self.B = np.array(B, dtype=np.float64)
        self.step = lru_cache(_CACHED_STEPS)(partial(discretise, self.A, self.B))

    def __call__(self, x: Vector, u: Vector, dt_ns: int) -> Vector:
        """Return x after ``dt_ns`` under the constant input ``u`` (shapes (n,), (m,))."""
        if dt_ns == 0:
            return x
        Ad, Bd = self.step(dt_ns)
        return product(Ad, x) + product(Bd, u)


def norm(vector: Vector) -> float:
    """Return the Euclidean norm ‖v‖₂ of a vector of shape (n,) without overflow of squares."""
    return norm_of(vector.tolist(), 0, len(vector))


def row_norms(rows: Matrix) -> Vector:
    """Return the Euclidean norms of k vectors, (k, n) → (k,), without overflow of squares.

    If the squares are safe, the results equal numpy's bit-exactly.
    """
    with np.errstate(over="ignore", under="ignore"):  # affected norms are recomputed below
        norms = np.asarray(np.linalg.norm(rows, axis=1))
    doubtful = (norms < _SAFE) | ~(norms < 1 / _SAFE)
    if doubtful.any():
        sizes = np.abs(rows[doubtful]).max(axis=1, initial=0.0)
        scales = np.where((sizes > 0) & np.isfinite(sizes), sizes, 1.0)
        norms[doubtful] = scales * np.linalg.norm(rows[doubtful] / scales[:, None], axis=1)
    return norms


def spectral_abscissa(matrix: Matrix) -> float:
    """Return the largest real part of the eigenvalues, per second."""
    return float(np.linalg.eigvals(matrix).real.max())
