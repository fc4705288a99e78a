"""Bounds of rows by norms (rule R11): what all forms may use as a fact, proven by induction over time.

A row here is Rz with Rż = MRz − y, where y = −Rż + MRz is an output with a proven bound |y| ≤ D, or 0. In
each location of the bound the row is at most N when the location is entered, and stays below E: with the
largest value T of the clock, as in :mod:`.event_times`,

    E > g N + I D, or E ≥ N if the row is still: M = 0, y = 0, and N does not decay with f1.

N follows at each edge from the facts of the edge, from the bounds in its source, and from one form.

Why the bounds may be used where they are proven: let all of this hold up to some time. Up to this time all
forms are ≤ 0, and Rz is strictly below E, also just after an edge. Between edges it is continuous, so it is
below E for a while longer; so there is no last such time. A row that is still keeps its bound.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from flint import arb, arb_mat, fmpq, fmpq_mat

from noack_kernel.document import Document, Edge, Location, Table, fields, mapping, name_of
from noack_kernel.event_times import Levels, growth, identity
from noack_kernel.exact import (
    Matrix,
    RejectedError,
    is_positive,
    rational,
    read_matrix,
    square,
    unit_rows,
    zeros,
)
from noack_kernel.forms import Forms, facts_at, multiplier, of_facts, of_units, read_levels


class _Within(NamedTuple):
    """N and E of a location, and s > 0 with E² > (1 + s) g² N² + (1 + 1/s) I² D²; None: N or D is 0."""

    enter: Levels
    within: Levels
    split: fmpq | None


class RowBound:
    """An entry of a proof: the bound of some rows.

    Args:
        document: what the loop is.
        entry: of the proof.

    Raises:
        RejectedError: it is malformed.
    """

    def __init__(self, document: Document, entry: Table) -> None:
        fields(entry, "row bound", {"name", "rows", "matrix", "in", "multipliers"}, {"output"})
        self._document = document
        self.name = name_of(entry["name"], "row bound")
        self.rows = read_matrix(entry["rows"], None, document.size)
        self._matrix = read_matrix(entry["matrix"], self.rows.height, self.rows.height)
        every = range(self.rows.height)
        if self.rows.radius is not None or self._matrix.radius is not None:
            raise RejectedError(f"{self.name}: rows or matrix are not exact")
        if not self.rows.is_zero(every, document.noise):
            raise RejectedError(f"{self.name}: noise has a part in the rows")
        self.output = None if "output" not in entry else name_of(entry["output"], self.name)
        if self.output is not None:
            self._require_output(self.output)
        table = mapping(entry["in"], self.name)
        if unknown := sorted({*table} - {*document.locations}):
            raise RejectedError(f"{self.name}: unknown location {unknown[0][:40]!r}")
        self._in = {place: self._read_within(mapping(value, place)) for place, value in table.items()}
        self._multipliers = mapping(entry["multipliers"], self.name)
        self._used: set[str] = set()

    def _require_output(self, name: str) -> None:
        output = self._document.outputs.get(name)
        if output is None or output.velocity is None or output.rows is None:
            raise RejectedError(f"{self.name}: {name[:40]!r} is no output with a velocity")
        is_same = output.velocity.equals(self.rows.times(fmpq(-1)))
        if not is_same or not output.rows.equals(self._matrix @ self.rows):
            raise RejectedError(f"{self.name}: the output is not −Rż + MRz, exactly")

    def _read_within(self, table: Table) -> _Within:
        fields(table, self.name, {"enter", "within"}, {"split"})
        enter, within = (read_levels(self._document, self.name, table[key]) for key in ("enter", "within"))
        split = rational(table["split"]) if "split" in table else None
        if split is not None and split <= 0:
            raise RejectedError(f"{self.name}: a split is not above 0")
        return _Within(enter, within, split)

    def fact(self, location: str) -> Matrix | None:
        """Return the matrix of |Rz|² − E1² f1² − E2² f2², which is ≤ 0 in a location; None: no bound."""
        if location not in self._in:
            return None
        return square(self.rows) - of_units(self._document, self._in[location].within)

    def verify(self, bounds: "RowBounds", levels: Mapping[str, Levels], forms: Mapping[str, Forms]) -> int:
        """Verify all inequalities, and return how many.

        Args:
            bounds: of all rows, which may be used.
            forms: those that have R3 and are verified, too, by their names.
            levels: D1² and D2² of proven bounds from the start on, by the names of outputs.

        Raises:
            RejectedError: the first that is not proven, or multipliers that belong to none.
        """
        count = 0
        for name, within in self._in.items():
            self._require_growth(self._document.locations[name], within, levels)
        for edge in self._document.edges:
            if edge.target in self._in:
                count += self._require_entered(edge, self._in[str(edge.target)], bounds, forms)
        if self._document.start in self._in:
            self._require_start(self._in[self._document.start])
            count += 1
        if unused := sorted({*self._multipliers} - self._used):
            raise RejectedError(f"{self.name}: multipliers of {unused[0][:80]!r}, which is no inequality")
        return count

    def _require_growth(self, location: Location, within: _Within, levels: Mapping[str, Levels]) -> None:
        """E² > (1 + s) g² N² + (1 + 1/s) I² D² in each unit."""
        place = f"{self.name} in {location.name}"
        deviation: Levels = (fmpq(0), fmpq(0))
        if self.output is None:
            self._require_exact(location)
        elif self.output not in levels:
            raise RejectedError(f"{self.name}: {self.output} has no bound from the start on")
        elif location.name not in self._document.outputs[self.output].locations:
            raise RejectedError(f"{place}: {self.output} has no bound there")
        else:
            deviation = levels[self.output]
        is_still = self.output is None and all(entry == 0 for entry in self._matrix.mid.entries())
        if location.motion and within.enter[0] > 0 and self._document.rate > 0:
            is_still = False  # f1 decays meanwhile
        if is_still and all(most >= enter for enter, most in zip(within.enter, within.within, strict=True)):
            return
        if is_still or location.clock is None:
            raise RejectedError(f"{place}: it may exceed the bound, or the clock has no limit")
        largest, total = growth(_shifted(self._matrix.mid, self._document.rate), arb(location.clock))
        if within.split is None and any(deviation) and any(within.enter):
            raise RejectedError(f"{place}: a split is missing")
        units = (self._document.decaying, self._document.constant)
        for enter, most, size, unit in zip(within.enter, within.within, deviation, units, strict=True):
            if unit is None:
                continue
            first, second = largest**2 * arb(enter), total**2 * arb(size)
            if within.split is not None:
                first, second = (1 + arb(within.split)) * first, (1 + 1 / arb(within.split)) * second
            if not first + second < arb(most) and not (most == 0 and enter == size == 0):
                raise RejectedError(f"{place}: it may exceed the bound")

    def _require_exact(self, location: Location) -> None:
        """Rż = MRz, exactly, with each corner and each unknown signal."""
        kept = [*location.coordinates, *self._document.noise]
        every = range(self.rows.height)
        for corner in location.motion:
            is_same = (self.rows @ corner.matrix - self._matrix @ self.rows).is_zero(every, kept)
            if not is_same or not all(
                (self.rows @ each.column).is_zero(every, [0]) for each in corner.unknown
            ):
                raise RejectedError(f"{self.name} in {location.name}: the rows move in another way")

    def _require_entered(
        self, edge: Edge, within: _Within, bounds: "RowBounds", forms: Mapping[str, Forms]
    ) -> int:
        """N1² f1² + N2² f2² + Σ m q + m V − |RJz|² ⪰ 0, where q are facts and bounds of rows in the source.

        V is a form, with one number m at all times of the edge, so that its nodes suffice.
        """
        place, source = f"edge/{edge.name}", self._document.locations[edge.source]
        table = self._numbers(place, {"facts", "form"})
        z = unit_rows(range(self._document.size), self._document.size)
        J = edge.jump  # f1 is smaller after an edge that lasts
        M = J.T @ of_units(self._document, within.enter) @ J - square(self.rows @ J)
        M += bounds.of_facts(
            place, {"facts": table.get("facts", {})}, facts_at(self._document, edge), source.name, z
        )
        kept = [*source.coordinates, *self._document.noise]
        added = self._form_at(place, edge, table, forms)
        if not all(is_positive((M + V).take(kept, kept)) for V in added):
            raise RejectedError(f"{self.name}: not proven at {place}")
        return len(added)

    def _form_at(self, place: str, edge: Edge, table: Table, forms: Mapping[str, Forms]) -> list[Matrix]:
        """Return m V at the nodes that cover the times of an edge; without a form one 0."""
        if "form" not in table:
            return [zeros(self._document.size, self._document.size)]
        entry = mapping(table["form"], place)
        fields(entry, place, {"name", "times"})
        form = forms.get(str(entry["name"]))
        if form is None:
            raise RejectedError(f"{place}: no form {str(entry['name'])[:40]!r} from the start on can be used")
        times = multiplier(place, entry["times"])
        return [form.P[edge.source][node].times(times) for node in form.times(edge)]

    def _require_start(self, within: _Within) -> None:
        Z, table = self._document.start_columns, self._numbers("start", {"facts"})
        M = Z.T @ of_units(self._document, within.enter) @ Z - square(self.rows @ Z)
        M += of_facts(self._document, "start", table, self._document.start_facts, Z)
        if not is_positive(M):
            raise RejectedError(f"{self.name}: not proven at start")

    def _numbers(self, name: str, keys: set[str]) -> Table:
        table = mapping(self._multipliers.get(name, {}), name)
        fields(table, name, set(), keys)
        self._used.add(name)
        return table


class RowBounds:
    """The bounds of all rows of a proof, which forms use as facts by their names.

    Raises:
        RejectedError: two have one name, or one has the name of a fact.
    """

    def __init__(self, document: Document, bounds: Sequence[RowBound]) -> None:
        self._document = document
        self._bounds = {bound.name: bound for bound in bounds}
        if len(self._bounds) < len(bounds) or {*self._bounds} & {*document.facts}:
            raise RejectedError("a bound of rows has the name of another one, or of a fact")

    def of_facts(self, name: str, table: Table, facts: Sequence[str], location: str, z: Matrix) -> Matrix:
        """Return Σ m q(z) of facts that hold, and of bounds of rows in a location.

        ``z``: rows of the variables of an inequality, (size, variables).
        """
        numbers = mapping(table.get("facts", {}), name)
        own = {each: value for each, value in numbers.items() if each not in self._bounds}
        total = of_facts(self._document, name, {"facts": own}, facts, z)
        for each, value in self._used(numbers):
            q = self._bounds[each].fact(location)
            if q is None:
                raise RejectedError(f"{name}: {each} has no bound in {location}")
            if value < 0:
                raise RejectedError(f"{name}: a multiplier below 0")
            total += (z.T @ q @ z).times(value)
        return total

    def _used(self, numbers: Mapping[str, object]) -> Iterator[tuple[str, fmpq]]:
        for name, value in numbers.items():
            if name in self._bounds:
                yield name, rational(value)

    def verify(self, levels: Mapping[str, Levels], forms: Mapping[str, Forms]) -> int:
        """Verify all bounds, and return the number of inequalities; see :meth:`RowBound.verify`."""
        return sum(bound.verify(self, levels, forms) for bound in self._bounds.values())


def _shifted(M: fmpq_mat, rate: fmpq) -> arb_mat:
    """Return M + r."""
    return arb_mat(M + identity(M.nrows()) * rate)
