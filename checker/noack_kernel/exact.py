"""Exact numbers, matrices of intervals, and the test that a symmetric matrix is positive semidefinite.

All arithmetic is rational, so that terms that should cancel do cancel. Only the last step of a test, LDLᵀ,
is computed in balls: a midpoint of 128 bits with a radius that contains the true value.
"""

import re
from collections.abc import Iterable, Sequence

from flint import arb, arb_mat, ctx, fmpq, fmpq_mat

ctx.prec = 128  # bits of a ball's midpoint

MOST_DIGITS = 400
"""Most characters of a number, and largest exponent of a decimal."""
_LARGEST, _SMALLEST = arb(10) ** 1000, arb(10) ** -1000
_AROUND_0 = arb(0, _SMALLEST.upper())
"""In place of smaller numbers, which would have millions of digits."""
_LARGEST_EXPONENT = 10**15
"""Of e, in which the numbers of a file may be in any unit."""
_LARGEST_DECAY = 2000
_MOST_BITS = 100_000
"""Of exact powers."""
_DECIMAL = re.compile(r"(-?)([0-9]+)(?:\.([0-9]+))?(?:[eE]([+-]?[0-9]+))?")
_QUOTIENT = re.compile(r"(-?[0-9]+)/([0-9]+)")


class RejectedError(ValueError):
    """The document is malformed, or the proof does not prove its bound; the message says where."""


def decimal(text: str) -> fmpq:
    """Return the exact value of a decimal such as ``-2.5e-3``."""
    match = _DECIMAL.fullmatch(text)
    if match is None or len(text) > MOST_DIGITS or abs(power := int(match[4] or 0)) > MOST_DIGITS:
        raise RejectedError(f"not a number, or too long: {text[:40]}")
    digits, places = int(match[2] + (match[3] or "")), len(match[3] or "")
    value = fmpq(digits, 10**places) * (fmpq(10**power) if power >= 0 else fmpq(1, 10**-power))
    return -value if match[1] else value


def rational(value: object) -> fmpq:
    """Return an exact number of a file: a decimal, as :func:`decimal` has read it, or a string "p/q"."""
    if isinstance(value, fmpq):
        return value
    match = _QUOTIENT.fullmatch(value) if isinstance(value, str) and len(value) <= 2 * MOST_DIGITS else None
    if match is None or int(match[2]) == 0:
        raise RejectedError(f"not a number: {str(value)[:40]!r}")
    return fmpq(int(match[1]), int(match[2]))


def whole(value: object) -> int:
    """Return a whole number ≥ 0 of a file."""
    found = rational(value)
    if found.q != 1 or found < 0:
        raise RejectedError(f"not a whole number: {found}")
    return int(found.p)


def times_power(value: fmpq, base: fmpq, exponent: int) -> fmpq:
    """Return value · base^exponent.

    Raises:
        RejectedError: it has too many digits.
    """
    if value.height_bits() + base.height_bits() * exponent > _MOST_BITS and base not in (0, 1):
        raise RejectedError(f"a power has more than {_MOST_BITS} bits")
    return value * base**exponent


class Matrix:
    """All matrices whose entries are within ``radius`` of ``mid``, both exact. The radius None is 0."""

    def __init__(self, mid: fmpq_mat, radius: fmpq_mat | None = None) -> None:
        self.mid, self.radius = mid, radius

    @property
    def height(self) -> int:
        """The number of rows."""
        return int(self.mid.nrows())

    @property
    def width(self) -> int:
        """The number of columns."""
        return int(self.mid.ncols())

    def __add__(self, other: "Matrix") -> "Matrix":
        radius = other.radius if self.radius is None else self.radius
        if self.radius is not None and other.radius is not None:
            radius = self.radius + other.radius
        return Matrix(self.mid + other.mid, radius)

    def __sub__(self, other: "Matrix") -> "Matrix":
        return self + other.times(fmpq(-1))

    def __matmul__(self, other: "Matrix") -> "Matrix":
        radius = None if other.radius is None else _sizes(self.mid) * other.radius
        if self.radius is not None:
            largest = _sizes(other.mid) if other.radius is None else _sizes(other.mid) + other.radius
            radius = self.radius * largest if radius is None else radius + self.radius * largest
        return Matrix(self.mid * other.mid, radius)

    def times(self, factor: fmpq) -> "Matrix":
        """Return a multiple."""
        return Matrix(self.mid * factor, None if self.radius is None else self.radius * abs(factor))

    @property
    def T(self) -> "Matrix":
        """The transposed matrix."""
        return Matrix(self.mid.transpose(), None if self.radius is None else self.radius.transpose())

    def take(self, rows: Sequence[int], columns: Sequence[int]) -> "Matrix":
        """Return some rows and columns."""
        places = [(i, j) for i in rows for j in columns]
        mid = fmpq_mat(len(rows), len(columns), [self.mid[place] for place in places])
        if self.radius is None:
            return Matrix(mid)
        return Matrix(mid, fmpq_mat(len(rows), len(columns), [self.radius[place] for place in places]))

    def is_zero(self, rows: Iterable[int], columns: Sequence[int]) -> bool:
        """Return whether entries are 0, exactly."""
        places = [(i, j) for i in rows for j in columns]
        return all(M is None or all(M[place] == 0 for place in places) for M in (self.mid, self.radius))

    def equals(self, other: "Matrix") -> bool:
        """Return whether the entries are the same, their radii included."""
        return self.mid == other.mid and self.radius == other.radius

    def has_row(self, index: int, entries: dict[int, fmpq]) -> bool:
        """Return whether a row has these entries, exactly, and 0 elsewhere."""
        columns = range(self.width)
        if self.radius is not None and any(self.radius[index, j] != 0 for j in columns):
            return False
        return all(self.mid[index, j] == entries.get(j, 0) for j in columns)


def _sizes(M: fmpq_mat) -> fmpq_mat:
    return fmpq_mat(M.nrows(), M.ncols(), [abs(entry) for entry in M.entries()])


def zeros(height: int, width: int) -> Matrix:
    """Return a matrix of zeros."""
    return Matrix(fmpq_mat(height, width))


def unit_rows(indices: Sequence[int], width: int) -> Matrix:
    """Return one row for each index, with a 1 at this index."""
    found = fmpq_mat(len(indices), width)
    for row, index in enumerate(indices):
        found[row, index] = fmpq(1)
    return Matrix(found)


def beside(left: Matrix, right: Matrix) -> Matrix:
    """Return two matrices with equally many rows, one beside the other."""
    columns, more = range(left.width), range(right.width)
    at_left = unit_rows(columns, left.width + right.width)
    at_right = unit_rows([left.width + j for j in more], left.width + right.width)
    return left @ at_left + right @ at_right


def square(rows: Matrix) -> Matrix:
    """Return RᵀR, the matrix of the quadratic form |Rz|²."""
    return rows.T @ rows


def product(left: Matrix, right: Matrix) -> Matrix:
    """Return LᵀR + RᵀL, the matrix of the quadratic form 2 (Lz)ᵀ(Rz)."""
    half = left.T @ right
    return half + half.T


def read_matrix(rows: object, height: int | None, width: int) -> Matrix:
    """Return a matrix of a file; an entry is a number, or an interval [low, high].

    Args:
        rows: as the file has them.
        height: the number of rows; None: any.
        width: the number of columns.
    """
    if not isinstance(rows, list) or (height is not None and len(rows) != height):
        raise RejectedError(f"not a matrix of {height} rows")
    if any(not isinstance(row, list) or len(row) != width for row in rows):
        raise RejectedError(f"a row has not {width} entries")
    mid, radius = fmpq_mat(len(rows), width), None
    for i, row in enumerate(rows):
        for j, entry in enumerate(row):
            if not isinstance(entry, list):
                mid[i, j] = rational(entry)
                continue
            if len(entry) != 2 or not rational(entry[0]) <= rational(entry[1]):
                raise RejectedError("an interval has not two ends in their order")
            low, high = map(rational, entry)
            radius = fmpq_mat(len(rows), width) if radius is None else radius
            mid[i, j], radius[i, j] = (low + high) / 2, (high - low) / 2
    return Matrix(mid, radius)


def symmetric(name: str, rows: object, size: int | None = None) -> Matrix:
    """Return a symmetric and exact matrix of a file."""
    height = (len(rows) if isinstance(rows, list) else 0) if size is None else size
    M = read_matrix(rows, height, height)
    if M.radius is not None or M.mid != M.mid.transpose():
        raise RejectedError(f"matrix {name[:40]}: not symmetric and exact")
    return M


def padded(M: Matrix, more: int) -> Matrix:
    """Return a square matrix with further rows and columns of zeros."""
    if not more:
        return M
    z = unit_rows(range(M.height), M.height + more)
    return z.T @ M @ z


def to_balls(M: Matrix) -> arb_mat:
    """Return a matrix whose balls contain all matrices in M."""
    found = arb_mat(M.mid)
    if M.radius is not None:
        for i in range(M.height):
            for j in range(M.width):
                found[i, j] += arb(0, arb(M.radius[i, j]).upper())
    return found


def from_balls(balls: arb_mat) -> Matrix:
    """Return all matrices in balls.

    Raises:
        RejectedError: an entry is not finite, or beyond 10¹⁰⁰⁰.
    """
    if not all(abs(entry) < _LARGEST for entry in balls.entries()):
        raise RejectedError("a product of matrices has an entry beyond 10^1000")
    kept = [entry if entry == 0 or not abs(entry) < _SMALLEST else _AROUND_0 for entry in balls.entries()]
    mid, radius = ([part(entry).fmpq() for entry in kept] for part in (arb.mid, arb.rad))
    size = balls.nrows(), balls.ncols()
    return Matrix(fmpq_mat(*size, mid), fmpq_mat(*size, radius) if any(r != 0 for r in radius) else None)


def exponential(F: Matrix, seconds: arb) -> arb_mat:
    """Return e^{Fs} in balls, for all matrices in F and all s in a ball; a row of zeros of F stays exact.

    Raises:
        RejectedError: the numbers in F s are so large that it takes long.
    """
    Fs = to_balls(F) * seconds
    sizes = (sum((abs(entry) for entry in row), arb(0)) for row in Fs.tolist())
    if not all(size < _LARGEST_EXPONENT for size in sizes):
        raise RejectedError(f"an exponent of e is beyond {_LARGEST_EXPONENT}")
    found = Fs.exp()
    for i in range(F.height):
        if F.has_row(i, {}):
            for j in range(F.width):
                found[i, j] = arb(int(i == j))
    return found


def power(M: arb_mat, exponent: int) -> arb_mat:
    """Return balls around each product of n matrices within M, which may differ; n is ``exponent``.

    flint squares a matrix by a rule of its own: the balls of M² contain A² for each A within M, but not each
    product A B.
    """
    found, factor = arb_mat(unit_rows(range(M.nrows()), M.nrows()).mid), M
    while exponent:
        if exponent % 2:
            found = factor * found
        exponent //= 2
        if exponent:
            factor = factor * arb_mat(factor)
    return found


def decay_below(rate: fmpq, seconds: fmpq) -> fmpq:
    """Return an exact number d ≤ e^{−rs}, close to it."""
    if rate * seconds > _LARGEST_DECAY:
        return fmpq(0)
    return arb(-rate * seconds).exp().lower().fmpq()


def is_definite(M: Matrix) -> bool:
    """Return whether all symmetric matrices in M are proven positive definite: no row is left out."""
    return all(M.mid[i, i] != 0 for i in range(M.height)) and is_positive(M)


def is_positive(M: Matrix) -> bool:
    """Return whether all symmetric matrices in M are proven positive semidefinite.

    LDLᵀ of M + Mᵀ in balls has positive pivots. Rows and columns of exact zeros are left out before it.
    """
    rest = [list(row) for row in arb_mat(M.mid + M.mid.transpose()).tolist()]
    if M.radius is not None:
        for row, sizes in zip(rest, (M.radius + M.radius.transpose()).tolist(), strict=True):
            for j, size in enumerate(sizes):
                if size != 0:
                    row[j] += arb(0, arb(size).upper())
    kept = [i for i, row in enumerate(rest) if not all(entry == 0 for entry in row)]
    rest = [[rest[i][j] for j in kept] for i in kept]
    for k, pivots in enumerate(rest):
        if not pivots[k] > 0:
            return False
        for i in range(k + 1, len(kept)):
            if pivots[i] == 0:
                continue
            factor = pivots[i] / pivots[k]
            for j in range(i, len(kept)):
                rest[i][j] -= factor * pivots[j]
    return True
