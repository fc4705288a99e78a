"""One bound: quadratic forms of each location, and the inequalities that prove it (rules R1 to R5).

V(z, θ) = zᵀP(θ)z with P of the location and of the clock θ, affine between nodes. "M ⪰ 0" is tested by
:func:`.exact.is_positive`. A fact q(z) = Σ|Rz|² − Σ|R'z|² is ≤ 0 where it holds, so m·q with a multiplier
m ≥ 0 may be added to what has to be ≥ 0; likewise τ(|p|² − |Rz|²) of an unknown signal p. Noise is another
one at each moment. It has no part in P, and stays in every inequality.

All inequalities are affine in the mixture of corners and, between nodes, in θ: corners and nodes suffice.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise

from flint import fmpq

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
)
from noack_kernel.exact import (
    Matrix,
    RejectedError,
    is_positive,
    padded,
    product,
    rational,
    read_matrix,
    square,
    unit_rows,
    whole,
    zeros,
)


class Forms:
    """The forms and multipliers of one entry of a proof, which has to be verified.

    Args:
        document: what the loop is.
        entry: of the proof.

    Raises:
        RejectedError: it is malformed.
    """

    def __init__(self, document: Document, entry: Table) -> None:
        fields(entry, "bound", {"output", "from", "decay", "levels", "matrices", "forms", "multipliers"})
        self._document = document
        self.name = name_of(entry["output"], "output")
        if self.name not in document.outputs:
            raise RejectedError(f"the document has no output {self.name[:40]!r}")
        self.output = document.outputs[self.name]
        if entry["from"] not in ("start", "limit"):
            raise RejectedError(f"{self.name}: a bound is from the start on, or in the limit")
        self.starts = entry["from"] == "start"
        self.decay = rational(entry["decay"])
        self.levels = self._read_levels(entry["levels"])
        self._matrices = {
            n: _symmetric(n, rows) for n, rows in mapping(entry["matrices"], "matrices").items()
        }
        self._multipliers = mapping(entry["multipliers"], "multipliers")
        table = mapping(entry["forms"], "forms")
        fields(table, "forms", {*document.locations})
        self.nodes: dict[str, list[fmpq]] = {}
        self.P: dict[str, list[Matrix]] = {}
        for location in document.locations.values():
            self._read_form(location, mapping(table[location.name], "forms"))
        self._used: set[str] = set()

    def _read_levels(self, value: object) -> tuple[fmpq, fmpq]:
        """Return D1² and D2²; one of a unit that the document lacks is 0."""
        if not isinstance(value, list) or len(value) != 2:
            raise RejectedError(f"{self.name}: levels are two numbers")
        levels = rational(value[0]), rational(value[1])
        units = self._document.decaying, self._document.constant
        for level, unit in zip(levels, units, strict=True):
            if level < 0 or (level > 0 and unit is None):
                raise RejectedError(f"{self.name}: a level below 0, or of a unit that the document lacks")
        return levels

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

    def verify(self) -> int:
        """Verify all inequalities, and return how many.

        Raises:
            RejectedError: the first that is not proven, or multipliers that belong to none.
        """
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
        for location in self._document.locations.values():
            for corner in location.motion:
                yield from self._of_motion(location, corner)
        for edge in self._document.edges:
            yield from self._of_edge(edge) if edge.target is not None else self._of_dead_edge(edge)
        if self.starts:
            yield self._of_start()
        for name in self.output.locations:
            yield from self._of_output(self.output, self._document.locations[name])

    def _of_motion(self, location: Location, corner: Corner) -> Iterator[tuple[str, Matrix]]:
        """R1: −(2 zᵀPż + zᵀP'z + ν zᵀPz) + Σ m q + Σ τ(|p|² − |Rz|²) ⪰ 0: then e^{νt} V does not increase."""
        nodes, forms = self.nodes[location.name], self.P[location.name]
        z, signals = self._variables(len(corner.unknown)), len(corner.unknown)
        for piece in range(max(len(nodes) - 1, 1)):
            slope = zeros(self._document.size, self._document.size)
            if len(nodes) > 1:
                slope = (forms[piece + 1] - forms[piece]).times(1 / (nodes[piece + 1] - nodes[piece]))
            for end in (piece, piece + 1) if len(nodes) > 1 else (0,):
                name = f"motion/{location.name}/{end}"
                P = forms[end]
                M = product(P @ z, corner.velocity) + padded(slope + P.times(self.decay), signals)
                M = self._with_facts(name, M.times(fmpq(-1)), location.facts, z, corner)
                yield name, self._within(location, M)

    def _of_edge(self, edge: Edge) -> Iterator[tuple[str, Matrix]]:
        """R2: zᵀP_s z − (Jz)ᵀP_t(Jz) + Σ m q ⪰ 0: then V does not increase."""
        facts, z = self._facts_at(edge), self._variables(0)
        for node, other in self._pairs(edge):
            name = f"edge/{edge.name}/{node} {other}"
            after = edge.jump.T @ self.P[str(edge.target)][other] @ edge.jump
            M = self._with_facts(name, self.P[edge.source][node] - after, facts, z, None)
            yield name, self._within(self._document.locations[edge.source], M)

    def _of_dead_edge(self, edge: Edge) -> Iterator[tuple[str, Matrix]]:
        """R5: zᵀPz + Σ m q − ε (f1² or f2²) ⪰ 0 with ε > 0: where V ≤ 0 the edge is never taken."""
        if not self.starts:
            raise RejectedError(
                f"{self.name}: in the limit nothing excludes {edge.name}, which leads nowhere"
            )
        facts, z = self._facts_at(edge), self._variables(0)
        for node in self._times(edge):
            name = f"edge/{edge.name}/{node}"
            M = self._with_facts(name, self.P[edge.source][node], facts, z, None)
            above = mapping(mapping(self._multipliers.get(name, {}), name).get("above", {}), name)
            if not above or any(rational(value) <= 0 for value in above.values()):
                raise RejectedError(
                    f"{self.name}: {edge.name} leads nowhere, and is not proven to be never taken"
                )
            for unit, value in above.items():
                if unit not in [self._document.coordinates[i] for i in self._document.units]:
                    raise RejectedError(f"{name}: {unit[:40]!r} is no unit")
                row = unit_rows([self._document.coordinates.index(unit)], self._document.size)
                M -= square(row).times(rational(value))
            yield name, self._within(self._document.locations[edge.source], M)

    def _facts_at(self, edge: Edge) -> list[str]:
        """Return the facts of an edge, and those of its source without noise, which is another one here."""
        document = self._document
        every = range(document.size)
        facts = document.locations[edge.source].facts
        still = [fact for fact in facts if document.facts[fact].is_zero(document.noise, every)]
        return [*dict.fromkeys([*edge.facts, *still])]

    def _times(self, edge: Edge) -> range:
        """Return the nodes of the source that cover the times of the clock at which the edge may be taken."""
        nodes = self.nodes[edge.source]
        low = max(i for i, node in enumerate(nodes) if node <= edge.first)
        reached = [] if edge.last is None else [i for i, node in enumerate(nodes) if node >= edge.last]
        return range(low, min(reached, default=len(nodes) - 1) + 1)

    def _pairs(self, edge: Edge) -> list[tuple[int, int]]:
        """Return the pairs of nodes at which R2 is tested: those that cover the times of the edge."""
        target = self._document.locations[str(edge.target)]
        nodes, others, times = self.nodes[edge.source], self.nodes[target.name], self._times(edge)
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
        return "start", self._with_facts("start", M, self._document.start_facts, Z, None)

    def _of_output(self, output: Output, location: Location) -> Iterator[tuple[str, Matrix]]:
        """R4: D1² f1² + D2² f2² + zᵀPz + Σ m q + Σ τ(…) − |y|² ⪰ 0: then |y|² ≤ D1² f1² + D2² f2²."""
        document = self._document
        depends = output.rows is None or output.velocity is not None
        for corner in location.motion if depends else location.motion[:1]:
            signals = corner if output.velocity is not None else None
            z = self._variables(len(corner.unknown) if signals else 0)
            if output.rows is None:
                y = corner.input.take([output.input or 0], range(document.size)) @ z
            else:
                y = output.rows @ z
            if output.velocity is not None:
                y += output.velocity @ corner.velocity
            units = zeros(document.size, document.size)
            for level, unit in zip(self.levels, (document.decaying, document.constant), strict=True):
                if unit is not None:
                    units += square(unit_rows([unit], document.size)).times(level)
            for node, P in enumerate(self.P[location.name]):
                name = f"output/{location.name}/{node}"
                V = padded(P + units, z.width - z.height)
                M = self._with_facts(name, V - square(y), location.facts, z, signals)
                yield name, self._within(location, M)

    # Parts of inequalities.

    def _variables(self, signals: int) -> Matrix:
        """Return z as rows of (z, p), with as many unknown signals p."""
        size = self._document.size
        return unit_rows(range(size), size + signals)

    def _with_facts(
        self, name: str, M: Matrix, facts: Sequence[str], z: Matrix, corner: Corner | None
    ) -> Matrix:
        """Return M + Σ m q(z), and with a corner + Σ τ(|p|² − |Rz|²) + Σ m(2 k p² − 2 p·Cz)."""
        table = mapping(self._multipliers.get(name, {}), name)
        self._used.add(name)
        fields(table, name, set(), {"facts", "unknown", "above"})
        of_facts = mapping(table.get("facts", {}), name)
        if unknown := sorted({*of_facts} - {*facts}):
            raise RejectedError(f"{name}: the fact {unknown[0][:40]!r} does not hold here")
        for fact, value in of_facts.items():
            q = self._document.facts[fact]
            q = z.T @ q @ z if name == "start" else padded(q, z.width - z.height)
            M += q.times(_multiplier(name, value))
        of_signals = table.get("unknown", [])
        if not isinstance(of_signals, list):
            raise RejectedError(f"{name}: multipliers of signals are no list")
        signals = [*of_signals]
        if corner is None:
            if signals:
                raise RejectedError(f"{name}: multipliers of signals, of which there are none")
            return M
        for index, signal in enumerate(corner.unknown):
            p = unit_rows([self._document.size + index], M.width)
            M += (square(p) - square(signal.rows @ z)).times(_next(name, signals))
            if signal.along is not None:
                along = square(p).times(2 * signal.least) - product(p, signal.along @ z)
                M += along.times(_next(name, signals))
        if signals:
            raise RejectedError(f"{name}: more multipliers than signals")
        return M

    def _within(self, location: Location, M: Matrix) -> Matrix:
        """Return the rows and columns of what is not 0 in a location: its coordinates, noise and signals."""
        kept = [*location.coordinates, *self._document.noise, *range(self._document.size, M.width)]
        return M.take(kept, kept)


def _symmetric(name: str, rows: object) -> Matrix:
    height = len(rows) if isinstance(rows, list) else 0
    M = read_matrix(rows, height, height)
    if M.radius is not None or M.mid != M.mid.transpose():
        raise RejectedError(f"matrix {name[:40]}: not symmetric and exact")
    return M


def _multiplier(name: str, value: object) -> fmpq:
    found = rational(value)
    if found < 0:
        raise RejectedError(f"{name}: a multiplier below 0")
    return found


def _next(name: str, signals: list[object]) -> fmpq:
    """Take the next multiplier of a list; a missing one is 0."""
    return _multiplier(name, signals.pop(0)) if signals else fmpq(0)
