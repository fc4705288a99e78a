"""The claim of a loop document about a plant's equations, which ``noack_equations`` verifies.

The document's motions are those of the linear plants that enclose the equations, as the search computed them.
Here their entries become intervals that contain what the claim needs exactly, rounding included.
"""

import hashlib
from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any, TypeAlias

from flint import arb, arb_mat, fmpq

from noack.core.balls import identity
from noack.plants.systems.equation_text import equation_lines
from noack.proof.elaborate.loop import Loop
from noack.proof.loop_document import LoopDocument, NoDocumentError, Table
from noack.proof.numbers import above, below, quotient, to_fraction
from noack_equations import LinearPlants, Region, RejectedError, enclose

Interval: TypeAlias = tuple[Fraction, Fraction]
Rows: TypeAlias = list[list[Interval]]
_NONE: Interval = (Fraction(0), Fraction(0))


def equations_text(statement: Mapping[str, object]) -> str:
    """Return the file of the equations that a statement is about; empty if it is about none."""
    equations = statement.get("equations")
    return (
        "".join(f"{line}\n" for line in equation_lines(equations)) if isinstance(equations, Mapping) else ""
    )


def add_claim(document: LoopDocument, statement: Mapping[str, object]) -> None:
    """Add the claim to a document's table, and widen its motions by the rounding of numbers.

    Args:
        document: of the loop, whose plant is on a region.
        statement: with its equations and its region, as the search has found it.

    Raises:
        NoDocumentError: the equations have no such claim.
    """
    claim = _Claim(document, _enclosed(document.loop, statement))
    for corners in document.table["motions"].values():
        for corner in corners:
            claim.widen(corner)
    document.table["equations"] = {"sha256": _digest(statement)} | claim.table()


def add_claim_of_gains(table: Table, loop: Loop, statement: Mapping[str, object]) -> None:
    """Add the claim to the table of a document for bounds by gains, as :func:`add_claim`."""
    plants = _enclosed(loop, statement)
    for key, M in (("A", plants.A), ("B", plants.B)):
        table[key] = [[_exactly(v) for v in row] for row in _rows(M)]
    halves = {key: _rows(M) for key, M in (("A", plants.half_A), ("B", plants.half_B))}
    if any(v != _NONE for rows in halves.values() for row in rows for v in row):
        table["uncertainty"] = {
            key: [[_exactly(_up(v)) for v in row] for row in M] for key, M in halves.items()
        }
    for entry, column in zip(table["disturbances"], _columns(plants), strict=False):
        entry["column"] = [[_exactly(v)] for v in column]
    table["equations"] = {"sha256": _digest(statement)}


def _enclosed(loop: Loop, statement: Mapping[str, object]) -> LinearPlants:
    """Return the plants that enclose a statement's equations, on the region that the document has."""
    equations = statement["equations"]
    assert isinstance(equations, Mapping)
    assert loop.region is not None
    region = Region(*(tuple(map(_as_written, limits)) for limits in loop.region))
    try:
        return enclose(equations, region)
    except RejectedError as error:
        raise NoDocumentError(str(error)) from None


def _digest(statement: Mapping[str, object]) -> str:
    return hashlib.sha256(equations_text(statement).encode()).hexdigest()


def _columns(plants: LinearPlants) -> Rows:
    n, count = plants.pushes.nrows(), plants.pushes.ncols()
    return [[_ball(plants.pushes[i, k]) for i in range(n)] for k in range(count)]


def _as_written(limit: arb | None) -> arb | None:
    """Return a limit as the document has it, which may be a decimal next to it."""
    if limit is None:
        return None
    value = _read(quotient(to_fraction(limit.lower())))[0]
    return arb(arb(fmpq(value.numerator, value.denominator)).upper())


class _Claim:
    def __init__(self, document: LoopDocument, plants: LinearPlants) -> None:
        model, loop = document.model, document.loop
        self._document, self._plants = document, plants
        self.states = [self._place(model.x, i) for i in range(loop.n)]
        errors = model.error_rows[0]
        seen = loop.seen if not model.sees_all else None
        self.of = _rows(identity(loop.n) if seen is None else seen)
        self.errors = [self._place(document_rows(errors, document), i) for i in range(len(self.of))]
        self.A, self.B, self.half_A, self.half_B = (_rows(M) for M in plants[:4])
        self.columns = [
            [_ball(plants.pushes[i, k]) for i in range(loop.n)] for k in range(plants.pushes.ncols())
        ]
        self.along = [
            None if all(entry == 0 for entry in along.row.entries()) else _rows(along.row)[0]
            for along in plants.along
        ]
        self.least = [max(below(to_fraction(along.least.lower())), 0.0) for along in plants.along]
        self.half_A, self.half_B = ([[_up(v) for v in row] for row in M] for M in (self.half_A, self.half_B))
        self.A, self.B = ([[_outward(v) for v in row] for row in M] for M in (self.A, self.B))
        self.columns = [[_outward(v) for v in column] for column in self.columns]
        self.along = [None if row is None else [_outward(v) for v in row] for row in self.along]

    def _place(self, rows: arb_mat, i: int) -> int:
        """Return the document's coordinate that a row of the model's coordinates is."""
        (found,) = (j for j, c in enumerate(self._document.used) if rows[i, c] != 0)
        return found

    def table(self) -> Table:
        """Return the claim."""
        names = [self._document.labels[c] for c in self._document.used]
        signals: list[Table] = []
        for column, along, least in zip(self.columns, self.along, self.least, strict=True):
            signals.append({"column": [[_written(v)] for v in column]})
            if along is not None:
                signals[-1] |= {"along": [[_written(v) for v in along]], "least": least}
        return {
            "states": [names[i] for i in self.states],
            "errors": [names[i] for i in self.errors],
            "of": _table(self.of),
            "A": _table(self.A),
            "B": _table(self.B),
            "half_A": _table(self.half_A),
            "half_B": _table(self.half_B),
            "signals": signals,
        }

    def widen(self, corner: Table) -> None:
        """Widen the intervals of a corner until they contain what the claim needs."""
        size = len(self._document.used)
        U = [[_read(entry) for entry in row] for row in corner["input"]]
        z = [[_unit(j == i) for j in range(size)] for i in self.states]
        velocity = _sum(_product(self.A, z), _product(self.B, U))
        F = corner["matrix"]
        for i, index in enumerate(self.states):
            F[index] = [_hull(entry, v) for entry, v in zip(F[index], velocity[i], strict=True)]
        for i, index in enumerate(self.errors):
            for j in range(size):
                radius = sum(
                    (abs(g[0]) * (v[j][1] - v[j][0]) / 2 for g, v in zip(self.of[i], velocity, strict=True)),
                    Fraction(0),
                )
                low, high = _read(F[index][j])
                if radius > (high - low) / 2:
                    middle = (low + high) / 2
                    F[index][j] = _written(_outward((middle - radius, middle + radius)))
        unknown = iter(corner["unknown"])
        for half, rows in ((self.half_A, z), (self.half_B, U)):
            for i, sizes in enumerate(half):
                for k, (_, most) in enumerate(sizes):
                    if most != 0:
                        column = [_unit(j == i) for j in range(len(half))]
                        self._widen(next(unknown), column, [_times((most, most), v) for v in rows[k]])
        constant = [_unit(self._document.labels[c] == "f2") for c in self._document.used]
        for column, along, least in zip(self.columns, self.along, self.least, strict=True):
            entry = next(unknown)
            self._widen(entry, column, constant)
            if along is not None and "along" in entry:
                n = len(self.states)
                needed = _sum(_product([along[:n]], z), _product([along[n:]], U))[0]
                entry["along"] = [[_hull(v, w) for v, w in zip(entry["along"][0], needed, strict=True)]]
                entry["least"] = least

    def _widen(self, entry: Table, column: Sequence[Interval], row: Sequence[Interval]) -> None:
        """Widen an unknown signal: its column of the states, that of the errors, and its row."""
        moved = _product(self.of, [[v] for v in column])
        for i, index in enumerate(self.states):
            entry["column"][index][0] = _hull(entry["column"][index][0], column[i])
        for i, index in enumerate(self.errors):
            low, high = moved[i][0]
            entry["column"][index][0] = _hull(entry["column"][index][0], (-high, -low))
        entry["rows"] = [[_hull(v, w) for v, w in zip(entry["rows"][0], row, strict=True)]]


def document_rows(rows: arb_mat, document: LoopDocument) -> arb_mat:
    """Return the rows of errors, of which each is one coordinate."""
    model = document.model
    if model.sees_all:
        return rows
    seen = document.loop.seen
    assert seen is not None
    return seen * rows


# Intervals, exactly.


def _ball(value: arb) -> Interval:
    return to_fraction(value.lower()), to_fraction(value.upper())


def _rows(M: arb_mat) -> Rows:
    return [[_ball(M[i, j]) for j in range(M.ncols())] for i in range(M.nrows())]


def _unit(is_one: bool) -> Interval:
    return (Fraction(int(is_one)),) * 2


def _read(entry: Any) -> Interval:
    if isinstance(entry, list):
        return _read(entry[0])[0], _read(entry[1])[1]
    value = Fraction(entry) if isinstance(entry, str | int) else Fraction(repr(entry))
    return value, value


def _written(value: Interval) -> Any:
    """Return an interval whose ends are decimals of floats, as a file has it."""
    low, high = (float(end) for end in value)
    return (
        (int(low) if low.is_integer() and abs(low) < 2**53 else low) if value[0] == value[1] else [low, high]
    )


def _exactly(value: Interval) -> Any:
    """Return a number exactly, or an interval outwards."""
    if value[0] != value[1]:
        return _written(_outward(value))
    low = float(value[0])
    return (
        _written(value) if Fraction(repr(low)) == value[0] else f"{value[0].numerator}/{value[0].denominator}"
    )


def _outward(value: Interval) -> Interval:
    """Return an interval whose ends are decimals of floats, outwards."""
    low, high = below(value[0]), above(value[1])
    return Fraction(repr(low)), Fraction(repr(high))


def _up(value: Interval) -> Interval:
    most = Fraction(repr(above(value[1])))
    return most, most


def _hull(entry: Any, needed: Interval) -> Any:
    """Return an entry of a document that has an interval, too; it stays as it is if it already has."""
    low, high = _read(entry)
    if low <= needed[0] and needed[1] <= high:
        return entry
    return _written(_outward((min(low, needed[0]), max(high, needed[1]))))


def _times(a: Interval, b: Interval) -> Interval:
    """Return a product as the kernel has it, by midpoints and radii."""
    (m, r), (n, s) = (((high + low) / 2, (high - low) / 2) for low, high in (a, b))
    radius = abs(m) * s + r * (abs(n) + s)
    return m * n - radius, m * n + radius


def _product(M: Rows, N: Rows) -> Rows:
    width = len(N[0]) if N else 0
    found = []
    for row in M:
        terms = [[_times(v, N[k][j]) for k, v in enumerate(row) if v != _NONE] for j in range(width)]
        found.append(
            [
                (sum((t[0] for t in each), Fraction(0)), sum((t[1] for t in each), Fraction(0)))
                for each in terms
            ]
        )
    return found


def _sum(M: Rows, N: Rows) -> Rows:
    return [
        [(a[0] + b[0], a[1] + b[1]) for a, b in zip(*rows, strict=True)] for rows in zip(M, N, strict=True)
    ]


def _table(M: Rows) -> list[list[Any]]:
    return [[_written(v) for v in row] for row in M]
