"""Linear time-invariant systems: exact propagation, exponentials, norms.

Time steps are integer nanoseconds; matrices are per second. The same step always gives the same
matrix, bit for bit, whether it was cached or not, and on every processor. A library's matrix
exponential depends on the processor, by the BLAS below it: two hosts of one run, or a run and its
replay on another machine, would then differ in the last bits of every state. So the core's is used
(native/loop/exponential.c).
"""

import math
import warnings
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from netem.core.core_library import CData
from noack.core.core_library import SCRATCH_MATRICES, core, ffi, pointer_to

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Stack = NDArray[np.float64]
"""Many matrices: those of a stack have the first indices, (…, k, n, r)."""

MatrixKey = tuple[tuple[int, ...], bytes]
"""Shape and bits of a matrix, by which equal matrices are known."""

_SINGULAR_STEP = 1e-12
"""A matrix is singular if its smallest singular value is below this share of its largest one, both in
units of the states in which rows and columns have similar sizes."""
_LOGARITHM_TOLERANCE = 1e-9
"""Largest relative difference between a matrix and the exponential of its logarithm."""
_CACHED_STEPS = 4096
"""Transition matrices that are kept."""
_NEGLIGIBLE = 1e-140
"""Smaller entries have no influence when a matrix is balanced."""
_MOST_ROUNDS, _LARGEST_EXPONENT = 20, 200
"""Most rounds of balancing, and the largest exponent."""


def exponential(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return e^M, (n, n). An entry that overflows is infinite or not a number."""
    contiguous = np.ascontiguousarray(matrix, np.float64)
    result, scratch = np.empty_like(contiguous), np.empty((SCRATCH_MATRICES, *contiguous.shape))
    if len(contiguous):
        pointers = (pointer_to(array, "double *") for array in (contiguous, result, scratch))
        core.noack_exponential(len(contiguous), *pointers)
    return result


def matrix_key(matrix: Matrix) -> MatrixKey:
    """Return the key of a matrix."""
    return matrix.shape, matrix.tobytes()


def matrix_of(key: MatrixKey) -> Matrix:
    """Return the matrix of a key; it cannot be changed."""
    shape, data = key
    return np.frombuffer(data).reshape(shape)


def transition(generator: Matrix, dt_ns: float) -> Matrix:
    """Return the transition matrix e^{G dt}, shape (n, n), of ``dz/dt = G z`` over ``dt_ns``."""
    return exponential(generator * (dt_ns * 1e-9))


def discretise(A: Matrix, B: Matrix, dt_ns: float) -> tuple[Matrix, Matrix]:
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


@lru_cache(maxsize=_CACHED_STEPS)
def _transition(generator: MatrixKey, dt_ns: int) -> Matrix:
    return transition(matrix_of(generator), dt_ns)


class Propagator:
    """Advances states of the autonomous system ``dz/dt = G z`` exactly; G is (n, n), per second.

    Transition matrices are cached by generator and step; a loop on a time grid has few distinct
    steps, and loops of one run may have equal models.
    """

    def __init__(self, generator: Matrix) -> None:
        self.generator = np.array(generator, dtype=np.float64)
        self._static = not self.generator.any()
        self._key = matrix_key(self.generator)

    def transition(self, dt_ns: int) -> Matrix:
        """Return e^{G dt}, (n, n)."""
        return _transition(self._key, dt_ns)

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

    def advance_by(self, states: Matrix, ages_ns: NDArray[np.int64], period_ns: int) -> Matrix:
        """Return e^{G t} of each of k states, (k, n), after its own time t, (k,): whole periods and a rest.

        A number of periods is followed bit by bit, so that a row does not depend on the others.
        Rests should be few: ages are near to multiples of the period.
        """
        advanced, (counts, rests_ns) = np.array(states, np.float64, order="C"), divmod(ages_ns, period_ns)
        bits = int(counts.max(initial=0)).bit_length()
        if bits and not self._static:
            powers = np.array([self.transition(period_ns << bit) for bit in range(bits)])
            steps, scratch = np.ascontiguousarray(counts, np.int64), np.empty(advanced.shape[1])
            core.noack_advance_by_periods(
                advanced.shape[1],
                bits,
                _reals(powers),
                len(advanced),
                pointer_to(steps, "int64_t *"),
                _reals(advanced),
                _reals(scratch),
            )
        for rest_ns in np.unique(rests_ns[rests_ns > 0]).tolist():
            advanced[rests_ns == rest_ns] = self.rows(advanced[rests_ns == rest_ns], rest_ns)
        return advanced


def norm(vector: Vector) -> float:
    """Return the Euclidean norm ‖v‖₂ of a vector of shape (n,) without overflow of squares."""
    return float(core.noack_norm(len(vector), _reals(vector)))


def product(matrix: Matrix, vector: Vector) -> Vector:
    """Return the matrix, (p, n), times the vector, (n,): the core's sums, from the left.

    numpy's last bits of a product depend on the processor and on the memory layout.
    """
    result = np.empty(len(matrix))
    core.noack_product(*matrix.shape, _reals(matrix), _reals(vector), _reals(result))
    return result


def real_logarithm(step: Matrix) -> Matrix | None:
    """Return the real L with e^L = ``step``, (n, n); None: there is none, or it is too inexact.

    A singular matrix has none: a part of the state is gone after the step. Neither has one with a negative
    eigenvalue that occurs once.
    """
    with warnings.catch_warnings(action="ignore"):  # the result is checked
        from scipy.linalg import expm, logm, matrix_balance  # takes 0.2 s: linear plants do not need it

        balanced, units = matrix_balance(step, permute=False)
        sizes = np.linalg.svd(balanced, compute_uv=False)
        if not sizes[-1] > _SINGULAR_STEP * sizes[0]:
            return None
        logarithm = np.asarray(np.real(logm(balanced)))
        if not np.isfinite(logarithm).all():
            return None
        is_inexact = np.abs(expm(logarithm) - balanced).max() > _LOGARITHM_TOLERANCE * np.abs(balanced).max()
    scales = np.diag(units)
    return None if is_inexact else logarithm * scales[:, None] / scales


def spectral_abscissa(matrix: Matrix) -> float:
    """Return the largest real part of the eigenvalues, per second."""
    return float(np.linalg.eigvals(matrix).real.max())


def balancing_exponents(sizes: Matrix) -> NDArray[np.int64]:
    """Return e for which rows and columns of S_ij 2^(e_i − e_j) have similar sizes, (n,).

    These are other units of the states, x_i 2^(e_i), which change no digit (Osborne, *J. ACM* 7,
    1960).

    Args:
        sizes: S, absolute values of entries, (n, n), finite.
    """
    exponents = np.zeros(len(sizes), np.int64)
    radius = float(np.abs(np.linalg.eigvals(sizes)).max())  # the same in all units
    radius = radius if radius > _NEGLIGIBLE else 1.0
    others = np.where(np.eye(len(sizes)) + (sizes < _NEGLIGIBLE), 0.0, sizes)
    for _ in range(_MOST_ROUNDS):
        earlier = exponents.copy()
        for i in range(len(sizes)):
            scaled = np.ldexp(others, exponents[:, None] - exponents)
            row, column = float(scaled[i].max()), float(scaled[:, i].max())
            # What has no influence, or is not influenced, has its other size near the radius.
            ratio = math.log2(column or radius) - math.log2(row or radius)
            exponents[i] += round(ratio / 2 if row and column else ratio)
        if (exponents == earlier).all():
            break
    return np.clip(exponents - int(np.median(exponents)), -_LARGEST_EXPONENT, _LARGEST_EXPONENT)


def _reals(values: Matrix | Vector) -> CData:
    return ffi.from_buffer("double[]", np.ascontiguousarray(values, np.float64))
