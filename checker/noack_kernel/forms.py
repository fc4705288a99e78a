"""Quadratic forms of each location, and the inequalities that prove a bound or a lemma (rules R1 to R6).

V(z, θ) = zᵀP(θ)z with P of the location and of the clock θ, affine between nodes. "M ⪰ 0" is tested by
:func:`.exact.is_positive`. A fact q(z) = Σ|Rz|² − Σ|R'z|² is ≤ 0 where it holds, so m·q with a multiplier
m ≥ 0 may be added to what has to be ≥ 0; likewise τ(|p|² − |Rz|²) of an unknown signal p. Noise is another
one at each moment. It has no part in P, and stays in every inequality.

All inequalities are affine in the mixture of corners and, between nodes, in θ: corners and nodes suffice.

R6: forms V₁, V₂, … that have R3 may use each other. If V̇ᵢ ≤ −νᵢ Vᵢ + Σ mᵢⱼ Vⱼ along motions, with j ≠ i and
mᵢⱼ ≥ 0, and Vᵢ⁺ ≤ Σ mᵢⱼ Vⱼ at edges, with mᵢⱼ ≥ 0, then all Vᵢ stay ≤ 0, since they are so at the start: such
a system of inequalities is cooperative. So Σ m V of other forms may be added to what has to be ≥ 0. In an
inequality that is affine in θ, such a number m is one number on each piece of the clock.

A bound may be one of the runs that visit some of the locations only. Then the others, with the edges to and
from them, are left out: the rest is a document, too.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Protocol

from flint import arb, fmpq

from noack_kernel.document import (
    MOST_NODES,
    Corner,
    Document,
    Edge,
    Location,
    Output,
    Table,
    entries,
    fields,
    mapping,
    name_of,
    names_of,
)
from noack_kernel.exact import (
    Matrix,
    RejectedError,
    decay_below,
    is_positive,
    padded,
    product,
    rational,
    square,
    symmetric,
    unit_rows,
    whole,
    zeros,
)


class KnownFacts(Protocol):
    """Facts of a document, and what is proven beside them."""

    def of_facts(self, name: str, table: Table, facts: Sequence[str], location: str, z: Matrix) -> Matrix:
        """Return Σ m q(z) with the multipliers of a table, for what holds in a location or at its edges."""


class Forms:
    """The forms and multipliers of one entry of a proof, which has to be verified.

    An entry is the proof of a bound, or a lemma, whose forms others use.

    Args:
        document: what the loop is.
        entry: of the proof.

    Raises:
        RejectedError: it is malformed.
    """

    def __init__(self, document: Document, entry: Table) -> None:
        of_kind = {"name"} if "name" in entry else {"output", "from", "levels"}
        required = of_kind | {"decay", "matrices", "forms", "multipliers"}
        fields(entry, "bound", required, {"only", "factors", "sub_step", "spread"})
        self._document = document
        self.output: Output | None = None
        self.starts, self.levels = True, (fmpq(0), fmpq(0))
        if "name" in entry:
            self.name = name_of(entry["name"], "lemma")
        else:
            self._read_bound(entry)
        self.locations, self.edges = visited(document, entry.get("only"))
        if self.starts and document.start not in self.locations:
            raise RejectedError(f"{self.name}: no run starts in the locations that the bound is for")
        self.decay = rational(entry["decay"])
        self._matrices = {n: symmetric(n, rows) for n, rows in mapping(entry["matrices"], "matrices").items()}
        self._multipliers = mapping(entry["multipliers"], "multipliers")
        self._factors = mapping(entry.get("factors", {}), "factors")
        fields(self._factors, "factors", set(), {edge.name for edge in self.edges})
        self._sub_step = rational(entry.get("sub_step", fmpq(1)))
        self._spread = rational(entry.get("spread", fmpq(1)))
        if not self._spread > 0:
            raise RejectedError(f"{self.name}: the spread is not above 0")
        table = mapping(entry["forms"], "forms")
        fields(table, "forms", {*self.locations})
        self.nodes: dict[str, list[fmpq]] = {}
        self.P: dict[str, list[Matrix]] = {}
        for location in self.locations.values():
            self._read_form(location, mapping(table[location.name], "forms"))
        self._used: set[str] = set()
        self._others: Mapping[str, Forms] = {}
        self._rows: KnownFacts | None = None
        self.never: set[str] = set()
        """Edges with ``to: null`` that :meth:`verify` has proven to be never taken."""

    @property
    def is_of_all_runs(self) -> bool:
        """Whether it is about runs that may visit all locations."""
        return len(self.locations) == len(self._document.locations)

    def _read_bound(self, entry: Table) -> None:
        self.name = name_of(entry["output"], "output")
        if self.name not in self._document.outputs:
            raise RejectedError(f"the document has no output {self.name[:40]!r}")
        self.output = self._document.outputs[self.name]
        if entry["from"] not in ("start", "limit"):
            raise RejectedError(f"{self.name}: a bound is from the start on, or in the limit")
        self.starts = entry["from"] == "start"
        self.levels = read_levels(self._document, self.name, entry["levels"])

    def _read_form(self, location: Location, table: Table) -> None:
        name = location.name
        fields(table, f"form of {name}", {"nodes", "terms"})
        if not isinstance(table["nodes"], list) or not isinstance(table["terms"], list):
            raise RejectedError(f"form of {name}: nodes or terms are no list")
        nodes = [rational(node) for node in table["nodes"]]
        if not 1 <= len(nodes) == len(table["terms"]) <= MOST_NODES or nodes[0] != 0:
            raise RejectedError(f"form of {name}: nodes that do not begin at 0, or not one form for each")
        if any(not a < b for a, b in pairwise(nodes)):
            raise RejectedError(f"form of {name}: nodes that do not ascend")
        if len(nodes) > 1 and (location.clock is None or nodes[-1] < location.clock):
            raise RejectedError(f"form of {name}: nodes that end before the clock does")
        self.nodes[name] = nodes
        self.P[name] = [self._sum(location, terms) for terms in table["terms"]]

    def _sum(self, location: Location, value: object) -> Matrix:
        """Return P, the sum of its terms: factors of named matrices, and of squares |Rz|²."""
        total, document = zeros(self._document.size, self._document.size), self._document
        for term in entries(value, f"form of {location.name}"):
            if "square" in term:
                fields(term, f"form of {location.name}", {"square", "times"})
                rows = term["square"]
                if not isinstance(rows, str) or rows not in document.rows:
                    raise RejectedError(f"form of {location.name}: unknown rows")
                total += square(document.rows[rows]).times(rational(term["times"]))
                continue
            fields(term, f"form of {location.name}", {"matrix", "on", "times"})
            V, on = self._matrices.get(str(term["matrix"])), term["on"]
            if V is None or not isinstance(on, list) or len(on) != V.height:
                raise RejectedError(f"form of {location.name}: unknown matrix, or not one of this size")
            chosen = [whole(each) for each in on]
            if not {*chosen} <= {*location.coordinates}:
                raise RejectedError(f"form of {location.name}: a coordinate that the location lacks")
            lift = unit_rows(chosen, document.size)
            total += (lift.T @ V @ lift).times(rational(term["times"]))
        if not total.is_zero(document.noise, range(document.size)):
            raise RejectedError(f"form of {location.name}: noise has a part in it")
        return total

    # The rules.

    def verify(self, others: Mapping[str, "Forms"], rows: KnownFacts) -> int:
        """Verify all inequalities, and return how many.

        Args:
            others: forms that may be used, by their names: those that have R3 and are verified, too.
            rows: sums facts, and bounds of rows that are verified, too (R11).

        Raises:
            RejectedError: the first that is not proven, or multipliers that belong to none.
        """
        self._others, self._rows = others, rows
        count = 0
        for name, M in self._inequalities():
            if not is_positive(M):
                raise RejectedError(f"{self.name}: not proven at {name}")
            count += 1
        if unused := sorted({*self._multipliers} - self._used):
            raise RejectedError(f"{self.name}: multipliers of {unused[0][:80]!r}, which is no inequality")
        return count

    def _inequalities(self) -> Iterator[tuple[str, Matrix]]:
        if not self.starts and not self.decay > 2 * self._document.rate:
            raise RejectedError(f"{self.name}: in the limit the decay is above twice the rate of the bound")
        for edge in self.edges:
            self._require_factor(edge)
        for location in self.locations.values():
            for corner in location.motion:
                yield from self._of_motion(location, corner)
        for edge in self.edges:
            if edge.target is not None:
                yield from self._of_edge(edge)
            elif any(self._above(edge, node) for node in self.times(edge)):
                yield from self._of_dead_edge(edge)
        if self.starts:
            yield self._of_start()
        if self.output is not None:
            yield from self._of_bound(self.output)

    def _of_bound(self, output: Output) -> Iterator[tuple[str, Matrix]]:
        """R4 in all locations of an output, and during edges."""
        for name in output.locations:
            if name in self.locations:
                yield from self._of_output(output, self.locations[name])
        for edge in self.edges:
            if output.during_edges and edge.duration > 0:
                yield from self._of_output_during(output, edge)

    def _factor(self, edge: Edge) -> fmpq:
        return rational(self._factors.get(edge.name, fmpq(1)))

    def _require_factor(self, edge: Edge) -> None:
        """Require λ ≥ 0 of an edge; in the limit also λ ≤ e^{−νT}, so that V ≤ C e^{−νt} over edges, too."""
        factor = self._factor(edge)
        if factor < 0:
            raise RejectedError(f"{self.name}: the factor of {edge.name} is below 0")
        if not self.starts and not arb(factor) <= arb(decay_below(self.decay, edge.duration)):
            raise RejectedError(f"{self.name}: in the limit the factor of {edge.name} is at most e^(−νT)")

    def _of_motion(self, location: Location, corner: Corner) -> Iterator[tuple[str, Matrix]]:
        """R1: −(2 zᵀPż + zᵀP'z + ν zᵀPz) + Σ m q + Σ τ(|p|² − |Rz|²) ⪰ 0: then e^{νt} V does not increase."""
        nodes, forms = self.nodes[location.name], self.P[location.name]
        z, signals = self._variables(len(corner.unknown)), len(corner.unknown)
        for piece in range(max(len(nodes) - 1, 1)):
            slope = zeros(self._document.size, self._document.size)
            if len(nodes) > 1:
                slope = (forms[piece + 1] - forms[piece]).times(1 / (nodes[piece + 1] - nodes[piece]))
            place = f"motion/{location.name}"
            table = self._table(f"{place}/piece {piece}", {"forms", "decay"})
            decay = rational(table["decay"]) if "decay" in table else self.decay
            if not self.starts and decay != self.decay:
                raise RejectedError(f"{place}: in the limit the decay is one number")
            for end in (piece, piece + 1) if len(nodes) > 1 else (0,):
                name = f"{place}/{end}"
                P = forms[end]
                M = product(P @ z, corner.velocity) + padded(slope + P.times(decay), signals)
                M = M.times(fmpq(-1)) + padded(self._used_forms(table, location, end), signals)
                M = self._with_facts(name, M, location.facts, location.name, z, corner)
                yield name, self._within(location, M)

    def _of_edge(self, edge: Edge) -> Iterator[tuple[str, Matrix]]:
        """R2: λ zᵀP_s z − (Jz)ᵀP_t(Jz) + Σ m q ⪰ 0 with λ ≥ 0: then V ≤ 0 stays so.

        λ is one number for each edge: λ P would be quadratic in the clock if both changed.
        """
        facts, z = facts_at(self._document, edge), self._variables(0)
        source, factor = self._document.locations[edge.source], self._factor(edge)
        for node, other in self._pairs(edge):
            name = f"edge/{edge.name}/{node} {other}"
            after = edge.jump.T @ self.P[str(edge.target)][other] @ edge.jump
            M = self.P[edge.source][node].times(factor) - after
            for used in self._used_at(f"edge/{edge.name}", source, self.times(edge), node):
                whole = self._with_facts(name, M + used, facts, source.name, z, None)
                yield name, self._within(source, whole)

    def _of_dead_edge(self, edge: Edge) -> Iterator[tuple[str, Matrix]]:
        """R5: zᵀPz + Σ m q − ε (f1² or f2²) ⪰ 0 with ε > 0: where V ≤ 0 the edge is never taken."""
        if not self.starts:
            raise RejectedError(f"{self.name}: in the limit nothing excludes {edge.name}")
        facts, z = facts_at(self._document, edge), self._variables(0)
        source = self._document.locations[edge.source]
        for node in self.times(edge):
            name = f"edge/{edge.name}/{node}"
            M = self.P[edge.source][node] - read_above(self._document, name, self._above(edge, node))
            for used in self._used_at(f"edge/{edge.name}", source, self.times(edge), node):
                whole = self._with_facts(name, M + used, facts, source.name, z, None)
                yield name, self._within(source, whole)
        self.never.add(edge.name)

    def _above(self, edge: Edge, node: int) -> Table:
        name = f"edge/{edge.name}/{node}"
        return mapping(mapping(self._multipliers.get(name, {}), name).get("above", {}), name)

    def times(self, edge: Edge) -> range:
        """Return the nodes of the source that cover the times of the clock at which the edge may be taken."""
        nodes = self.nodes[edge.source]
        low = max(i for i, node in enumerate(nodes) if node <= edge.first)
        reached = [] if edge.last is None else [i for i, node in enumerate(nodes) if node >= edge.last]
        return range(low, min(reached, default=len(nodes) - 1) + 1)

    def _pairs(self, edge: Edge) -> list[tuple[int, int]]:
        """Return the pairs of nodes at which R2 is tested: those that cover the times of the edge."""
        target = self._document.locations[str(edge.target)]
        nodes, others, times = self.nodes[edge.source], self.nodes[target.name], self.times(edge)
        if edge.clock == "zero" or len(others) == 1:
            return [(i, 0) for i in times]
        if edge.clock == "any" or len(nodes) == 1:
            return [(i, j) for i in times for j in range(len(others))]
        # The clock goes on, and stays below that of the target: at equal nodes both forms are affine.
        reached = [i for i, node in enumerate(nodes) if target.clock is not None and node >= target.clock]
        last = min([times.stop - 1, *reached])
        if nodes[: last + 1] != others[: last + 1]:
            raise RejectedError(f"{self.name}: {edge.name}: the clock goes on, but the nodes differ")
        return [(i, i) for i in range(times.start, last + 1)]

    def _of_start(self) -> tuple[str, Matrix]:
        """R3: −z(0)ᵀPz(0) + Σ m q ⪰ 0. With R1 and R2, V ≤ 0 at all times."""
        Z, P = self._document.start_columns, self.P[self._document.start][0]
        M = (Z.T @ P @ Z).times(fmpq(-1))
        return "start", self._with_facts("start", M, self._document.start_facts, "", Z, None)

    def _of_output(self, output: Output, location: Location) -> Iterator[tuple[str, Matrix]]:
        """R4: D1² f1² + D2² f2² + zᵀPz + Σ m q + Σ τ(…) − |y|² ⪰ 0: then |y|² ≤ D1² f1² + D2² f2²."""
        document, corners = self._document, tuple[Corner | None, ...](location.motion)
        if output.rows is not None and output.velocity is None:
            corners = (None,)  # y does not depend on how z moves
        for corner in corners:
            signals = corner if output.velocity is not None else None
            z = self._variables(0 if signals is None else len(signals.unknown))
            y = zeros(0, z.width)
            if output.rows is not None:
                y = output.rows @ z
            elif corner is not None:
                y = corner.input.take([output.input or 0], range(document.size)) @ z
            if output.velocity is not None and corner is not None:
                y += output.velocity @ corner.velocity
            units, times = of_units(document, self.levels), range(len(self.nodes[location.name]))
            for node in times:
                name = f"output/{location.name}/{node}"
                for used in self._used_at(f"output/{location.name}", location, times, node):
                    V = padded(self.P[location.name][node] + used + units, z.width - z.height)
                    M = self._with_facts(name, V - square(y), location.facts, location.name, z, signals)
                    yield name, self._within(location, M)

    def _of_output_during(self, output: Output, edge: Edge) -> Iterator[tuple[str, Matrix]]:
        """R4 during an edge, with z, the form and the facts of its beginning; f1 has decayed by then.

        See :mod:`.jumps`: |y|² ≤ (1 + a)|r z|² + (1 + 1/a) zᵀBz on a part of a flow. All parts of an edge use
        the same multipliers, which are called during/EDGE.
        """
        document, a = self._document, self._spread
        if output.rows is None:
            return
        name, facts, z = f"during/{edge.name}", facts_at(document, edge), self._variables(0)
        for part in document.products.during(edge.steps, output.rows, self._sub_step):
            decay = decay_below(document.rate, part.end)
            levels = self.levels[0] * decay * decay, self.levels[1]
            rest = of_units(document, levels) - part.beyond.times(1 + 1 / a)
            for rows in part.ends:
                y = square(rows).times(1 + a)
                for node in self.times(edge):
                    M = self.P[edge.source][node] + rest - y
                    M = self._with_facts(name, M, facts, edge.source, z, None)
                    yield name, self._within(document.locations[edge.source], M)

    # Parts of inequalities.

    def _used_at(self, place: str, location: Location, times: range, node: int) -> Iterator[Matrix]:
        """Yield Σ m P of other forms at a node, for each piece of the clock there that has other numbers."""
        pieces = [times.start]
        if len(times) > 1:
            pieces = [piece for piece in (node - 1, node) if piece in range(times.start, times.stop - 1)]
        tables: list[Table] = []
        for piece in pieces:
            table = self._table(f"{place}/piece {piece}", {"forms"})
            if table not in tables:
                tables.append(table)
                yield self._used_forms(table, location, node)

    def _used_forms(self, table: Table, location: Location, node: int) -> Matrix:
        """Return Σ m P of other forms at a node of a location."""
        total = zeros(self._document.size, self._document.size)
        for name, value in mapping(table.get("forms", {}), location.name).items():
            used = self._others.get(name)
            if used is None or used is self:
                raise RejectedError(f"{self.name}: no other form {name[:40]!r} from the start on can be used")
            if used.nodes[location.name] != self.nodes[location.name]:
                raise RejectedError(f"{self.name}: the form {name} has other nodes in {location.name}")
            total += used.P[location.name][node].times(multiplier(location.name, value))
        return total

    def _table(self, name: str, keys: set[str]) -> Table:
        """Return the numbers of a piece of a clock."""
        table = mapping(self._multipliers.get(name, {}), name)
        fields(table, name, set(), keys)
        self._used.add(name)
        return table

    def _variables(self, signals: int) -> Matrix:
        """Return z as rows of (z, p), with as many unknown signals p."""
        size = self._document.size
        return unit_rows(range(size), size + signals)

    def _with_facts(
        self, name: str, M: Matrix, facts: Sequence[str], place: str, z: Matrix, corner: Corner | None
    ) -> Matrix:
        """Return M + Σ m q(z), and with a corner + Σ τ(|p|² − |Rz|²) + Σ m(2 k p² − 2 p·Cz)."""
        table = mapping(self._multipliers.get(name, {}), name)
        self._used.add(name)
        fields(table, name, set(), {"facts", "unknown", "above"})
        if self._rows is None or not place:
            M += of_facts(self._document, name, table, facts, z)
        else:
            M += self._rows.of_facts(name, table, facts, place, z)
        of_signals = table.get("unknown", [])
        if not isinstance(of_signals, list):
            raise RejectedError(f"{name}: multipliers of signals are no list")
        signals = [*of_signals]
        if corner is None:
            if signals:
                raise RejectedError(f"{name}: multipliers of signals, of which there are none")
            return M
        for within, along in corner.squares:
            M += within.times(_next(name, signals))
            if along is not None:
                M += along.times(_next(name, signals))
        if signals:
            raise RejectedError(f"{name}: more multipliers than signals")
        return M

    def _within(self, location: Location, M: Matrix) -> Matrix:
        """Return the rows and columns of what is not 0 in a location: its coordinates, noise and signals."""
        kept = [*location.coordinates, *self._document.noise, *range(self._document.size, M.width)]
        return M.take(kept, kept)


def visited(document: Document, only: object) -> tuple[dict[str, Location], list[Edge]]:
    """Return the locations that a statement is about, with the edges between them; None: all.

    Raises:
        RejectedError: one is unknown, or there is none.
    """
    if only is None:
        return document.locations, document.edges
    names = names_of(only, document.locations, "only")
    if not names:
        raise RejectedError("only: no location")
    edges = [e for e in document.edges if e.source in names and (e.target is None or e.target in names)]
    return {name: document.locations[name] for name in names}, edges


def read_levels(document: Document, name: str, value: object) -> tuple[fmpq, fmpq]:
    """Return D1² and D2² of |y|² ≤ D1² f1² + D2² f2²; a number of a unit that the document lacks is 0."""
    if not isinstance(value, list) or len(value) != 2:
        raise RejectedError(f"{name}: levels are two numbers")
    levels = rational(value[0]), rational(value[1])
    for level, unit in zip(levels, (document.decaying, document.constant), strict=True):
        if level < 0 or (level > 0 and unit is None):
            raise RejectedError(f"{name}: a level below 0, or of a unit that the document lacks")
    return levels


def of_units(document: Document, levels: tuple[fmpq, fmpq]) -> Matrix:
    """Return the matrix of D1² f1² + D2² f2²."""
    total = zeros(document.size, document.size)
    for level, unit in zip(levels, (document.decaying, document.constant), strict=True):
        if unit is not None:
            total += square(unit_rows([unit], document.size)).times(level)
    return total


def read_above(document: Document, name: str, value: Table) -> Matrix:
    """Return the matrix of ε (f1² or f2²), or of a sum of both, with each ε > 0; there is at least one."""
    if not value or any(rational(each) <= 0 for each in value.values()):
        raise RejectedError(f"{name}: not proven to be never taken: nothing is above 0")
    total = zeros(document.size, document.size)
    for unit, each in value.items():
        if unit not in [document.coordinates[i] for i in document.units]:
            raise RejectedError(f"{name}: {unit[:40]!r} is no unit")
        row = unit_rows([document.coordinates.index(unit)], document.size)
        total += square(row).times(rational(each))
    return total


def facts_at(document: Document, edge: Edge) -> list[str]:
    """Return the facts of an edge, and those of its source without noise, which is another one here."""
    every = range(document.size)
    facts = document.locations[edge.source].facts
    still = [fact for fact in facts if document.facts[fact].is_zero(document.noise, every)]
    return [*dict.fromkeys([*edge.facts, *still])]


def of_facts(document: Document, name: str, table: Table, facts: Sequence[str], z: Matrix) -> Matrix:
    """Return Σ m q(z) with the multipliers of a table, for facts that hold.

    ``z``: rows of the variables of an inequality, (size, variables).
    """
    numbers = mapping(table.get("facts", {}), name)
    if unknown := sorted({*numbers} - {*facts}):
        raise RejectedError(f"{name}: the fact {unknown[0][:40]!r} does not hold here")
    total = zeros(z.width, z.width)
    for fact, value in numbers.items():
        total += (z.T @ document.facts[fact] @ z).times(multiplier(name, value))
    return total


def multiplier(name: str, value: object) -> fmpq:
    """Return a number of a proof that has to be ≥ 0."""
    found = rational(value)
    if found < 0:
        raise RejectedError(f"{name}: a multiplier below 0")
    return found


def _next(name: str, signals: list[object]) -> fmpq:
    """Take the next multiplier of a list; a missing one is 0."""
    return multiplier(name, signals.pop(0)) if signals else fmpq(0)
