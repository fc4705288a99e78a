"""Real numbers as balls, with python-flint: what a function returns contains the true value.

A ball is a midpoint with a radius, ``arb``; comparisons such as ``a > b`` are true only if they hold
for all numbers of the two balls. A matrix is an ``arb_mat``.
"""

from collections.abc import Iterable, Sequence

from flint import arb, arb_mat, ctx

ctx.prec = 128  # bits of midpoints
_SQUARINGS = 8


def zeros(rows: int, columns: int) -> arb_mat:
    """Return a matrix of zeros."""
    return arb_mat(rows, columns)


def identity(n: int) -> arb_mat:
    """Return the identity, (n, n)."""
    return arb_mat(n, n, [int(i == j) for i in range(n) for j in range(n)])


def transpose(M: arb_mat) -> arb_mat:
    """Return the transposed matrix."""
    return M.transpose()


def beside(left: arb_mat, right: arb_mat) -> arb_mat:
    """Return two matrices with equal numbers of rows, one beside the other."""
    pairs = zip(left.tolist(), right.tolist(), strict=True)
    entries: list[arb] = [entry for row, other in pairs for entry in (*row, *other)]
    return arb_mat(left.nrows(), left.ncols() + right.ncols(), entries)


def columns_of(M: arb_mat, chosen: Iterable[int]) -> arb_mat:
    """Return some columns of a matrix."""
    columns = [*chosen]
    return arb_mat(M.nrows(), len(columns), [M[i, j] for i in range(M.nrows()) for j in columns])


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


def between(low: arb, high: arb) -> arb:
    """Return a ball that contains [low, high]."""
    return low + upto(high - low)


def upper(value: arb) -> arb:
    """Return an exact number that is at least a value which is not negative."""
    return arb(value.abs_upper())


def frobenius(M: arb_mat) -> arb:
    """Return the root of the sum of squares of the entries, a bound of the spectral norm."""
    return arb(sum((entry * entry for entry in M.entries()), arb(0)).upper()).sqrt()


def spectral_norm(M: arb_mat, squarings: int = _SQUARINGS) -> arb:
    """Return an upper bound of ‖M‖₂: the root of trace((MᵀM)^k)^(1/k), k = 2^squarings."""
    power = square(M)
    for _ in range(squarings):
        power = power * power
    trace = sum((power[i, i] for i in range(power.nrows())), arb(0))
    return arb(trace.abs_upper()).root(2 ** (squarings + 1))


def norm_of(M: arb_mat) -> arb:
    """Return an upper bound of ‖M‖₂."""
    if is_zero(M):
        return arb(0)
    return frobenius(M) if min(M.nrows(), M.ncols()) == 1 else spectral_norm(M)


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
