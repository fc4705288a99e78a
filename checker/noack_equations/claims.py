"""Does a loop document allow what a plant's equations do? Rules E1 to E4.

A document's key ``equations`` claims that within its limits (``while``), for all x and u and at all times,

    f(x, u) = A x + B u + Σ_ik e_i Δ_ik z_k + Σ_s c_s p_s,   z = (x, u),

with |Δ_ik| ≤ h_ik, |p_s| ≤ 1, and p_s · C_s z ≥ k_s p_s² where a signal goes along with something.

* E1, the equations: on the region they lie within linear plants with unknown entries and signals, which
  :mod:`.enclosure` finds. These have to be within what is claimed, entry by entry and signal by signal.
* E2, the motions. In each corner of each motion u = Uz, and the rows of the states are A x + B U z; its first
  unknown signals are those of Δ, with the rows h_k z_k, then those of p, in this order. So whatever the
  mixture λ of the corners, Σ λ_i (F_i z + Σ c p_i) has f(x, u) for the states: with one Δ and one p for all
  corners, a signal of Δ is Δ_k/h_k times the row of its corner, and the mixture of these rows is h_k z_k.
* E3, the copies. Errors e = G(x_s − x) with a copy x_s that no signal moves: their rows are −G times those of
  the states, plus rows that are exact; and so are the columns of the signals.
* E4, nothing else: all other rows of these signals are exactly 0. Further unknown signals may be there; they
  are no part of the equations, and the sentence says how many. Edges leave the states as they are, since the
  plant's state is continuous, and take no time, in which nothing would be compared.

What is added to the document's numbers are intervals; an entry has to contain what is needed.
"""

import re
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import NamedTuple

from flint import arb, fmpq, fmpq_mat

from noack_equations.enclosure import LinearPlants, Region, RejectedError, enclose
from noack_equations.text import block_of, steps_of
from noack_gains import Document as DocumentOfGains
from noack_gains import RejectedError as RejectedByGainsError
from noack_kernel.document import FORMAT, Corner, Document, Table, entries, fields, read_table, strings
from noack_kernel.exact import Matrix, rational, read_matrix, unit_rows
from noack_kernel.exact import RejectedError as RejectedByKernelError

MOST_STATES = 40
_PLAIN_NAME = re.compile(r"[\w' ()-]+")


class Signal(NamedTuple):
    """A signal p of the equations, |p| ≤ 1: ẋ has ``column`` p, and p·(``along`` z) ≥ ``least`` p²."""

    column: Matrix
    along: Matrix | None
    least: fmpq


class Claim(NamedTuple):
    """What a document claims of a plant's equations."""

    digest: str
    states: list[int]
    """Their coordinates."""
    errors: list[int]
    """Coordinates of e = G(x_s − x)."""
    of: Matrix
    """G, (q, n)."""
    A: Matrix
    B: Matrix
    half_A: Matrix
    half_B: Matrix
    signals: list[Signal]

    @property
    def n(self) -> int:
        """The number of states."""
        return len(self.states)

    @property
    def m(self) -> int:
        """The number of inputs."""
        return self.B.width


class Proven(NamedTuple):
    """What was proven of equations."""

    digest: str
    states: list[str]
    limits: list[str]
    further: int
    """So many unknown signals of a motion are not of the equations."""

    def __str__(self) -> str:
        within = f" for {' and '.join(self.limits)}" if self.limits else " for all x and u"
        more = f", beside {self.further} unknown signals of its own," if self.further else ""
        return (
            f"the document allows all{more} that the equations with the SHA-256 {self.digest} do{within}; "
            f"their x is ({', '.join(self.states)})"
        )


def prove_equations(document: str, equations: str) -> Proven:
    """Return what is proven of a document and of a file with equations; both are the contents of files.

    Raises:
        RejectedError: the document does not allow what the equations do, or a file is malformed.
    """
    if is_of_gains(document):
        return _prove_for_gains(document, equations)
    try:
        loop = Document(document)
        claim = read_claim(loop, loop.equations)
        region = region_of_limits(loop, claim)
        steps = steps_of(block_of(equations, claim.digest))
        _require_enclosed(claim, enclose(steps, region))
        _require_still_edges(loop, claim, document)
        further = [
            _require_allowed(loop, claim, name, corner)
            for name, corners in loop.motions.items()
            for corner in _with_one_input(claim, name, corners)
        ]
    except RejectedByKernelError as error:
        raise RejectedError(str(error)) from None
    limits = [f"|{_quoted(limit.output)}| < {float(arb(limit.less).mid()):.6g}" for limit in loop.limits]
    states = [_quoted(loop.coordinates[i]) for i in claim.states]
    return Proven(claim.digest, states, limits, max(further, default=0))


def _quoted(name: str) -> str:
    """Return a name, in quotes if it could be taken for a part of the sentence."""
    return name if _PLAIN_NAME.fullmatch(name) else repr(name)


def claimed_digest(document: str) -> str | None:
    """Return the SHA-256 of the equations that a well-formed document claims something of; None: of none."""
    if is_of_gains(document):
        return DocumentOfGains(document).equations
    table = Document(document).equations
    digest = None if table is None else table.get("sha256")
    return digest[:64] if isinstance(digest, str) else None


def lines_of_equations() -> int:
    """Return the number of lines of this program, as its files have them."""
    folder = Path(__file__).parent
    return sum(len(re.findall(r"\n", path.read_text())) for path in sorted(folder.glob("*.py")))


def is_of_gains(document: str) -> bool:
    """Return whether a document is one for bounds by gains."""
    try:
        DocumentOfGains(document)
    except RejectedByGainsError:
        return False
    return True


def _prove_for_gains(document: str, equations: str) -> Proven:
    """E1 for a document of bounds by gains, which states A, B, half-widths and disturbances as they are."""
    loop = DocumentOfGains(document)
    if loop.equations is None:
        raise RejectedError("equations: the document claims nothing of a plant's equations")
    x: list[arb | None] = [None] * loop.n
    u: list[arb | None] = [None] * loop.m
    for limit in loop.limits:
        output = loop.output(limit.output)
        if output.input is not None:
            u[output.input] = _smaller(u[output.input], arb(limit.less))
        elif output.rows is not None and output.rows.shape[0] == 1 and output.rows.radius is None:
            used = [j for j in range(loop.n) if output.rows.mid[0, j] != 0]
            if len(used) == 1:
                less = arb(limit.less / abs(output.rows.mid[0, used[0]]))
                x[used[0]] = _smaller(x[used[0]], less)
    plants = enclose(steps_of(block_of(equations, loop.equations)), Region(tuple(x), tuple(u)))
    count = plants.pushes.ncols()
    if any(most < 1 for _, most in loop.disturbances[:count]):
        raise RejectedError("equations: a disturbance is smaller than the signal of the equations")
    signals = [Signal(Matrix(*column), None, fmpq(0)) for column, _ in loop.disturbances[:count]]
    A, B, half_A, half_B = (Matrix(*M) for M in (loop.A, loop.B, loop.half_A, loop.half_B))
    none = Matrix(fmpq_mat(0, loop.n))
    claim = Claim(loop.equations, [*range(loop.n)], [], none, A, B, half_A, half_B, signals)
    _require_enclosed(claim, plants)
    limits = [f"|{_quoted(limit.output)}| < {float(arb(limit.less).mid()):.6g}" for limit in loop.limits]
    return Proven(loop.equations, [*map(_quoted, loop.states)], limits, len(loop.disturbances) - count)


# Reading.


def read_claim(document: Document, table: Table | None) -> Claim:
    """Return the claim of a document.

    Raises:
        RejectedError: it has none.
        RejectedByKernelError: it is malformed.
    """
    if table is None:
        raise RejectedError("equations: the document claims nothing of a plant's equations")
    required = {"sha256", "states", "errors", "of", "A", "B", "half_A", "half_B", "signals"}
    fields(table, "equations", required)
    digest = table["sha256"]
    if not isinstance(digest, str) or len(digest) != 64 or {*digest} - {*"0123456789abcdef"}:
        raise RejectedError("equations: sha256: not 64 hexadecimal digits")
    states, errors = (_indices(document, table, key) for key in ("states", "errors"))
    n = len(states)
    if not 0 < n <= MOST_STATES or {*states} & {*errors}:
        raise RejectedError("equations: no states, too many, or one that is an error")
    m = {corner.input.height for corners in document.motions.values() for corner in corners}
    if len(m) != 1:
        raise RejectedError("equations: motions with different numbers of inputs")
    (inputs,) = m
    half_A, half_B = (read_matrix(table[key], n, width) for key, width in (("half_A", n), ("half_B", inputs)))
    for half in (half_A, half_B):
        if half.radius is not None or any(entry < 0 for entry in half.mid.entries()):
            raise RejectedError("equations: half-widths are exact, and not below 0")
    of = read_matrix(table["of"], len(errors), n)
    if of.radius is not None:
        raise RejectedError("equations: of: an interval, where numbers are exact")
    return Claim(
        digest,
        states,
        errors,
        of,
        read_matrix(table["A"], n, n),
        read_matrix(table["B"], n, inputs),
        half_A,
        half_B,
        [_read_signal(entry, n, inputs) for entry in entries(table["signals"], "equations")],
    )


def _indices(document: Document, table: Table, key: str) -> list[int]:
    names = strings(table[key], "equations")
    if len({*names}) < len(names) or not {*names} <= {*document.coordinates}:
        raise RejectedError(f"equations: {key}: a name that is no coordinate, or one twice")
    found = [document.coordinates.index(name) for name in names]
    if {*found} & {*document.units, *document.noise}:
        raise RejectedError(f"equations: {key}: a unit or noise is none")
    return found


def _read_signal(entry: Table, n: int, m: int) -> Signal:
    fields(entry, "equations", {"column"}, {"along", "least"})
    if ("along" in entry) != ("least" in entry):
        raise RejectedError("equations: along and least belong together")
    column = read_matrix(entry["column"], n, 1)
    if "along" not in entry:
        return Signal(column, None, fmpq(0))
    least = rational(entry["least"])
    if least < 0:
        raise RejectedError("equations: least is below 0")
    return Signal(column, read_matrix(entry["along"], 1, n + m), least)


def region_of_limits(document: Document, claim: Claim) -> Region:
    """Return the region in which the document's limits keep states and inputs: E1 holds there."""
    x: list[arb | None] = [None] * claim.n
    u: list[arb | None] = [None] * claim.m
    for limit in document.limits:
        output = document.outputs[limit.output]
        if output.input is not None:
            u[output.input] = _smaller(u[output.input], arb(limit.less))
        elif output.rows is not None and output.rows.height == 1 and output.rows.radius is None:
            used = [j for j in range(document.size) if output.rows.mid[0, j] != 0]
            if len(used) == 1 and used[0] in claim.states:
                place = claim.states.index(used[0])
                x[place] = _smaller(x[place], arb(limit.less / abs(output.rows.mid[0, used[0]])))
    return Region(tuple(x), tuple(u))


def _smaller(limit: arb | None, other: arb) -> arb:
    found = other if limit is None else limit.min(other)
    return arb(found.upper())


# E1.


def _require_enclosed(claim: Claim, plants: LinearPlants) -> None:
    """E1: the claimed plants are all that enclose the equations."""
    if plants.B.ncols() != claim.m or plants.A.nrows() != claim.n:
        raise RejectedError("equations: not as many states and inputs as the document has")
    blocks = (
        ("A", claim.A, claim.half_A, plants.A, plants.half_A),
        ("B", claim.B, claim.half_B, plants.B, plants.half_B),
    )
    for name, M, half, found, found_half in blocks:
        for i, k in product(range(M.height), range(M.width)):
            room = half.mid[i, k] - arb(found_half[i, k].upper()).fmpq()
            if not _contains(M, i, k, found[i, k], room):
                raise RejectedError(f"equations: the slope {name}[{i}, {k}] is not within what is claimed")
    found_signals, signals = plants.pushes.ncols(), len(claim.signals)
    if found_signals != signals:
        raise RejectedError(f"signals: the equations have {found_signals}, the document has {signals}")
    for k, (signal, along) in enumerate(zip(claim.signals, plants.along, strict=True)):
        for i in range(claim.n):
            if not _contains(signal.column, i, 0, plants.pushes[i, k], fmpq(0)):
                raise RejectedError(f"equations: the signal {k} is larger than what is claimed")
        if signal.along is None:
            continue
        row = signal.along
        if not all(_contains(row, 0, j, along.row[0, j], fmpq(0)) for j in range(row.width)):
            raise RejectedError(f"equations: the signal {k} goes along with something else")
        if not arb(signal.least) <= along.least:
            raise RejectedError(f"equations: the signal {k} is not known to take so much")


def _contains(M: Matrix, i: int, j: int, value: arb, room: fmpq) -> bool:
    """Return whether an entry of M, an interval, has all values of a ball, with some room at both ends."""
    if not value.is_finite():
        return False
    radius = room + (fmpq(0) if M.radius is None else M.radius[i, j])
    low, high = M.mid[i, j] - radius, M.mid[i, j] + radius
    return bool(low <= value.lower().fmpq()) and bool(value.upper().fmpq() <= high)


# E2 to E4.


class _Expected(NamedTuple):
    """An unknown signal that a corner needs."""

    name: str
    column: Matrix
    """Of the states, (n, 1)."""
    rows: Matrix
    along: Matrix | None
    least: fmpq


def _require_still_edges(document: Document, claim: Claim, text: str) -> None:
    """E4: no edge changes a state, or takes time."""
    for edge in document.edges:
        for index in claim.states if edge.target is not None else ():
            if not edge.jump.has_row(index, {index: fmpq(1)}):
                name = document.coordinates[index]
                raise RejectedError(f"equations: edge {edge.name}: it changes the state {name!r}")
    if any("duration" in entry for entry in entries(read_table(text, FORMAT, "document")["edges"], "edges")):
        raise RejectedError("equations: an edge takes time, in which nothing is compared")


def _with_one_input(claim: Claim, name: str, corners: tuple[Corner, ...]) -> tuple[Corner, ...]:
    """Return the corners of a motion; one signal for all of them needs an ``along`` of the states alone."""
    depends = [s for s in claim.signals if s.along is not None and not _is_of_states(s.along, claim.n)]
    if len(corners) > 1 and depends:
        raise RejectedError(
            f"equations: motion {name}: a signal goes along with the input, which is a mixture"
        )
    return corners


def _is_of_states(row: Matrix, n: int) -> bool:
    return row.is_zero([0], range(n, row.width))


def _require_allowed(document: Document, claim: Claim, name: str, corner: Corner) -> int:
    """E2 to E4 for a corner of a motion; return how many signals are not of the equations."""
    place = f"equations: motion {name}"
    size = document.size
    z = unit_rows(claim.states, size)
    velocity = claim.A @ z + claim.B @ corner.input
    for i, index in enumerate(claim.states):
        for j in range(size):
            where = f"{place}: the row of {document.coordinates[index]!r}"
            _require(corner.matrix, index, j, velocity, i, j, where)
    moved = (claim.of @ velocity).times(fmpq(-1))
    for i, index in enumerate(claim.errors):
        for j in range(size):
            free = fmpq(0) if moved.radius is None else moved.radius[i, j]
            if free > (fmpq(0) if corner.matrix.radius is None else corner.matrix.radius[index, j]):
                raise RejectedError(f"{place}: the row of {document.coordinates[index]!r} is too narrow")
    expected = [*_expected(document, claim, z, corner)]
    if len(corner.unknown) < len(expected):
        raise RejectedError(f"{place}: fewer unknown signals than the equations have")
    others = [i for i in range(size) if i not in (*claim.states, *claim.errors)]
    for signal, unknown in zip(expected, corner.unknown, strict=False):
        where = f"{place}: {signal.name}"
        errors = (claim.of @ signal.column).times(fmpq(-1))
        for indices, column in ((claim.states, signal.column), (claim.errors, errors)):
            for i, index in enumerate(indices):
                _require(unknown.column, index, 0, column, i, 0, where)
        if not unknown.column.is_zero(others, [0]):
            raise RejectedError(f"{where}: it moves other coordinates, too")
        if unknown.rows.height != 1:
            raise RejectedError(f"{where}: not one row")
        for j in range(size):
            _require(unknown.rows, 0, j, signal.rows, 0, j, where)
        if unknown.along is None:
            continue
        if signal.along is None or unknown.least > signal.least:
            raise RejectedError(f"{where}: it is not known to take so much")
        for j in range(size):
            _require(unknown.along, 0, j, signal.along, 0, j, where)
    return len(corner.unknown) - len(expected)


def _expected(document: Document, claim: Claim, z: Matrix, corner: Corner) -> Iterator[_Expected]:
    """Yield the unknown signals of a corner, in their order."""
    n = claim.n
    for letter, half, rows in (("A", claim.half_A, z), ("B", claim.half_B, corner.input)):
        for i, k in product(range(n), range(half.width)):
            if half.mid[i, k] == 0:
                continue
            column = Matrix(fmpq_mat(n, 1, [int(j == i) for j in range(n)]))
            row = rows.take([k], range(rows.width)).times(half.mid[i, k])
            yield _Expected(f"the entry {letter}[{i}, {k}]", column, row, None, fmpq(0))
    if claim.signals and document.constant is None:
        raise RejectedError("equations: signals need a constant coordinate")
    for k, signal in enumerate(claim.signals):
        one = Matrix(fmpq_mat(1, document.size, [int(j == document.constant) for j in range(document.size)]))
        along = None
        if signal.along is not None:
            of_x, of_u = (
                signal.along.take([0], columns) for columns in (range(n), range(n, signal.along.width))
            )
            along = of_x @ z + of_u @ corner.input
        yield _Expected(f"the signal {k}", signal.column, one, along, signal.least)


def _require(M: Matrix, i: int, j: int, needed: Matrix, row: int, column: int, place: str) -> None:
    """Require an entry of a document to contain the interval that is needed."""
    radius = fmpq(0) if M.radius is None else M.radius[i, j]
    size = fmpq(0) if needed.radius is None else needed.radius[row, column]
    if abs(M.mid[i, j] - needed.mid[row, column]) + size > radius:
        raise RejectedError(f"{place} does not contain the interval that the equations give")
