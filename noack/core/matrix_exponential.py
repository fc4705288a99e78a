"""The exponential of a small matrix, with the same bits on every processor.

A library's depends on the processor, by the BLAS below it. Two hosts of one run, or a run and its
replay on another machine, would then differ in the last bits of every state.

The method is scaling and squaring with Taylor's polynomial of degree 16 (Higham, Functions of
Matrices, 2008, ch. 10). The number of halvings follows from norms of powers of the matrix (Al-Mohy
and Higham, SIAM J. Matrix Anal. Appl. 31(3), 2009, theorem 4.2): a large input matrix beside
small dynamics is not scaled too much, which would cost accuracy.
"""

import math

import numpy as np
from numpy.typing import NDArray

_DEGREE = 16
_LARGEST = 0.78
"""Up to this α the polynomial is the exponential of a matrix that differs by less than 2⁻⁵³ of its
norm (Al-Mohy and Higham, SIAM J. Sci. Comput. 33(2), 2011, table 3.1)."""
_TERMS = [1.0 / math.factorial(k) for k in range(_DEGREE + 1)]


def exponential(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return e^M, (n, n). An entry that overflows is infinite or not a number."""
    with np.errstate(over="ignore", invalid="ignore", under="ignore"):
        # Scaled to a norm of at most 1 first: its powers do not overflow.
        halved = _halvings(_norm(matrix), 1.0)
        first = np.ldexp(matrix, -halved)
        second = _product(first, first)
        third, fourth = _product(second, first), _product(second, second)
        alpha = max(_norm(third) ** (1 / 3), _norm(fourth) ** (1 / 4))
        more = _halvings(math.ldexp(alpha, halved), _LARGEST) - halved
        powers = [
            np.ldexp(one, -more * k) for k, one in enumerate((first, second, third, fourth), 1)
        ]
        found = _polynomial(powers)
        for _ in range(halved + more):
            found = _product(found, found)
    return found


def _polynomial(powers: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return Taylor's polynomial from M, M², M³ and M⁴ (Paterson and Stockmeyer, 1973)."""
    fourth, one = powers[3], np.eye(len(powers[0]))
    found = _TERMS[_DEGREE] * fourth
    for k in range(_DEGREE - 4, -1, -4):
        if k < _DEGREE - 4:
            found = _product(found, fourth)
        for j in (3, 2, 1):
            found += _TERMS[k + j] * powers[j - 1]
        found += _TERMS[k] * one
    return found


def _product(left: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the product of two matrices; each sum is formed from the left."""
    terms = left[:, :, np.newaxis] * right
    found: NDArray[np.float64] = np.add.accumulate(terms, axis=1)[:, -1]
    return found


def _norm(matrix: NDArray[np.float64]) -> float:
    """Return the largest sum of sizes in a column."""
    return float(np.add.accumulate(np.abs(matrix), axis=0)[-1].max(initial=0.0))


def _halvings(size: float, largest: float) -> int:
    """Return how often to halve a size until it is at most ``largest``."""
    if not 0.0 < size < math.inf:
        return 0
    mantissa, exponent = math.frexp(size / largest)
    return max(exponent - (mantissa == 0.5), 0)
