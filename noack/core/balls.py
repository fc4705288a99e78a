"""Real numbers as balls, with python-flint: what a function returns contains the true value.

A ball is a midpoint with a radius, ``arb``; comparisons such as ``a > b`` are true only if they hold
for all numbers of the two balls. A matrix is an ``arb_mat``.
"""

from collections.abc import Iterable, Sequence
from fractions import Fraction

from flint import arb, arb_mat, ctx, fmpq

ctx.prec = 128  # bits of midpoints


def number(value: float | Fraction) -> arb:
    """Return a number; a float is the exact binary value that it has."""
    if isinstance(value, Fraction):
        return arb(fmpq(value.numerator, value.denominator))
    return arb(value)


def matrix(rows: Sequence[Sequence[float | Fraction]]) -> arb_mat:
    """Return a matrix from its rows."""
    return arb_mat([[number(value) for value in row] for row in rows])


def zeros(rows: int, columns: int) -> arb_mat:
    """Return a matrix of zeros."""
    return arb_mat(rows, columns)


def identity(n: int) -> arb_mat:
    """Return the identity, (n, n)."""
    return arb_mat(n, n, [int(i == j) for i in range(n) for j in range(n)])


def transpose(M: arb_mat) -> arb_mat:
    """Return the transposed matrix."""
    return M.transpose()


def stack(blocks: Iterable[arb_mat]) -> arb_mat:
    """Return matrices with equal numbers of columns, one below the other."""
    present = [block for block in blocks if block.nrows()]
    rows = sum(block.nrows() for block in present)
    return arb_mat(rows, present[0].ncols(), [entry for block in present for entry in block.entries()])


def beside(left: arb_mat, right: arb_mat) -> arb_mat:
    """Return two matrices with equal numbers of rows, one beside the other."""
    return transpose(stack([transpose(left), transpose(right)]))


def columns_of(M: arb_mat, chosen: Sequence[int]) -> arb_mat:
    """Return some columns of a matrix."""
    return arb_mat(M.nrows(), len(chosen), [M[i, j] for i in range(M.nrows()) for j in chosen])


def rows_of(M: arb_mat, chosen: Sequence[int]) -> arb_mat:
    """Return some rows of a matrix."""
    return arb_mat(len(chosen), M.ncols(), [M[i, j] for i in chosen for j in range(M.ncols())])


def square(M: arb_mat) -> arb_mat:
    """Return MᵀM."""
    return transpose(M) * M


def is_zero(M: arb_mat) -> bool:
    """Return whether all entries are exactly 0."""
    return all(entry == 0 for entry in M.entries())


def around_zero(radius: arb) -> arb:
    """Return the ball of all numbers of at most this size."""
    return arb(0, radius.abs_upper())


def upto(end: arb) -> arb:
    """Return a ball that contains [0, end]."""
    return end / 2 + around_zero(end / 2)


def frobenius(M: arb_mat) -> arb:
    """Return the root of the sum of squares of the entries, a bound of the spectral norm."""
    return arb(sum((entry * entry for entry in M.entries()), arb(0)).upper()).sqrt()


def is_positive(M: arb_mat) -> bool:
    """Return whether all symmetric matrices in M are proven positive semidefinite, by LDLᵀ.

    All pivots have to be above 0; a row and column of exact zeros is left out.
    """
    n = M.nrows()
    rest = [[(M[i, j] + M[j, i]) / 2 for j in range(n)] for i in range(n)]
    for k in range(n):
        if not rest[k][k] > 0:
            if all(rest[k][j] == 0 for j in range(k, n)):
                continue
            return False
        for i in range(k + 1, n):
            if rest[k][i] == 0:
                continue
            factor = rest[k][i] / rest[k][k]
            for j in range(i, n):
                rest[i][j] -= factor * rest[k][j]
    return True
