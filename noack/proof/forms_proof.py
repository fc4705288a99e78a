"""The proof of a document's bounds for the kernel, from the matrices and multipliers of a search."""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from typing import Any

from flint import arb

from noack.core.balls import is_zero
from noack.proof.elaborate.hybrid_system import Edge, Signal
from noack.proof.error_rows import ErrorRows
from noack.proof.event_times import EventTimes, levels_of
from noack.proof.loop_document import DRIFT, ERROR, ETA, LoopDocument, Table
from noack.proof.numbers import as_written, quotient, simplest
from noack.proof.quiet_start import write_quiet_start
from noack.proof.search.results import compares_error

FORMAT = "noack-forms 1"


def write_bound(document: LoopDocument, found: Mapping[str, Any]) -> Table:
    """Return the proof of one bound.

    Args:
        document: of the loop.
        found: what a search has found: output, decay, matrices and numbers, and whether it is from the start.
    """
    return _Bound(document, found).table()


class _Bound:
    def __init__(self, document: LoopDocument, found: Mapping[str, Any]) -> None:
        self._document, self._model, self._found = document, document.model, found
        self._numbers: Mapping[str, float] = found["numbers"]
        self._multipliers: dict[str, Table] = {}

    def table(self) -> Table:
        """Return the entry of the proof."""
        model, document = self._model, self._document
        forms = {place.name: self._form(index) for index, place in enumerate(model.locations)}
        for index in range(len(model.locations)):
            self._of_location(index)
        for edge, name in document.edges:
            self._of_edge(edge, name)
        self._of_silent_edges()
        facts = [document.fact(Q) for Q in model.noise_bounds]
        self._add("start", self._facts("m/start", facts))
        level = [self._numbers.get(f"level {k}", 0.0) for k in (1, 2)]
        return {
            "output": document.output_names[str(self._found["output"])],
            "from": "start" if self._found.get("from_start", True) else "limit",
            "decay": self._found["decay"],
            "levels": level,
            "matrices": self._found["matrices"],
            "forms": forms,
            "multipliers": self._multipliers,
        }

    # Forms.

    def _form(self, index: int) -> Table:
        place = self._model.locations[index]
        nodes = [quotient(simplest(node)) for node in place.nodes]
        return {"nodes": nodes, "terms": [[*self._terms(index, node)] for node in range(len(place.nodes))]}

    def _terms(self, index: int, node: int) -> Iterator[Table]:
        model, document = self._model, self._document
        place, form = model.locations[index], model.form(index, node)
        for name, rows in form.parts:
            on = []
            for i in range(rows.nrows()):
                (j,) = (j for j in range(rows.ncols()) if rows[i, j] != 0)
                on.append(document.used.index(place.coordinates[j]))
            yield {
                "matrix": name,
                "on": on,
                "times": quotient(self._size(index, node, name.removeprefix("P/"))),
            }
        for name, _ in form.scalars:
            number, kind = as_written(self._numbers.get(name, 0.0)), name.split("/")[0]
            if kind in ("c1", "c2"):
                size = self._size(index, node, name.removeprefix(f"{kind}/"))
                yield {"square": f"f{kind[1]}", "times": quotient(-number * size)}
            elif kind == "eta":
                size = self._size(index, node, name.removeprefix("eta/"))
                yield {"square": ETA, "times": quotient(number * size)}
            else:
                theta = simplest(place.nodes[node])
                for rows_name, sign in self._compared(name.removeprefix(f"a/{place.name}")):
                    yield {"square": rows_name, "times": quotient(-number * theta * sign)}

    def _size(self, index: int, node: int, name: str) -> Fraction:
        """Return the factor of a named matrix or number in a location's form."""
        if not self._model.is_by_tests:
            return Fraction(1)
        sizes = dict(self._model.names_by_tests(index, node))
        return simplest(sizes[name]) if name in sizes else Fraction(1)

    def _compared(self, term: str) -> list[tuple[str, int]]:
        """Return the squares of a form's term in the comparison, with their signs."""
        rows = self._document.rows
        if not self._model.has_silent_edges:
            signs = {"compared": 1, "share": -1, "level": -1, "floor": -1}
            return [(name, sign) for name, sign in signs.items() if name in rows]
        return [{
            "": ("compared without noise", 1),
            "/N": ("share without noise", -1),
            "/c1": ("f1", -1),
            "/c2": ("f2", -1),
        }[term]]  # fmt: skip

    # Multipliers.

    def _of_location(self, index: int) -> None:
        place = self._model.locations[index]
        signals = [*self._model.signals(place.flows[0].input)]
        others = len(place.flows[0].unknowns) - len(signals)
        for kind, name in (("flow", "motion"), ("output", "output")):
            for node in range(len(place.nodes)):
                key = f"m/{kind}/{place.name}/{node}"
                table = self._facts(key, self._document.location_facts[index])
                depends = kind == "flow" or self._found["output"] == DRIFT
                if depends and (values := [*self._signals(key, signals, others)]) and any(values):
                    table["unknown"] = values
                self._add(f"{name}/{place.name}/{node}", table)

    def _signals(self, key: str, signals: Sequence[Signal], others: int) -> Iterator[float]:
        """Yield multipliers of signals, of which the search had those over the root of their size."""
        for k, signal in enumerate(signals):
            yield float((arb(self._numbers.get(f"{key}/signal {k}", 0.0)) / signal.size).mid())
            if signal.along is not None:
                yield float((arb(self._numbers.get(f"{key}/along {k}", 0.0)) / signal.size.sqrt()).mid())
        for k in range(len(signals), len(signals) + others):
            yield self._numbers.get(f"{key}/signal {k}", 0.0)

    def _of_edge(self, edge: Edge, name: str) -> None:
        facts, model = self._document.facts_of(edge), self._model
        source = self._document.location_facts[edge.source]
        silent = len(model.locations[edge.source].silent)
        if model.is_guarded:
            facts += source[silent:] + ([] if model.sources else source[:silent])
        for node, other in edge.pairs:
            table = self._facts(f"m/edge/{edge.name}/{node} {other}", facts)
            if edge.memory is not None and not is_zero(edge.memory):
                self._add_memory(table, facts[len(edge.facts) - 1], edge.target, other)
            self._add(f"edge/{name}/{node} {other}", table)

    def _add_memory(self, table: Table, fact: str, target: int, node: int) -> None:
        """Add the coefficient of η in the target's form to the multiplier of what η is after the test."""
        numbers = table.setdefault("facts", {})
        names = [name for name, _ in self._model.names_by_tests(target, node)]
        total = (
            as_written(numbers.get(fact, 0.0))
            if not isinstance(numbers.get(fact), str)
            else Fraction(numbers[fact])
        )
        for name in names:
            total += as_written(self._numbers.get(f"eta/{name}", 0.0)) * self._size(target, node, name)
        numbers[fact] = quotient(total)

    def _of_silent_edges(self) -> None:
        """A silent test at θ leaves V as it is, minus θ a times the comparison, which is at most 0."""
        for index in self._document.silent_locations:
            place = self._model.locations[index]
            a = self._numbers.get(f"a/{place.name}", 0.0)
            for node in range(1, len(place.nodes)):
                value = quotient(as_written(a) * simplest(place.nodes[node]))
                self._add(f"edge/{place.name}, silent/{node} 0", {"facts": {"silent": value}} if a else {})

    def _facts(self, key: str, facts: Sequence[str]) -> Table:
        found: dict[str, Any] = {}
        for index, fact in enumerate(facts):
            if value := self._numbers.get(f"{key}/{index}", 0.0):
                found[fact] = quotient(as_written(value) + as_written(found.get(fact, 0.0)))
        return {"facts": found} if found else {}

    def _add(self, name: str, table: Table) -> None:
        if table:
            self._multipliers[name] = table


def write_proof(document: LoopDocument, bounds: Sequence[Mapping[str, Any]], apart_s: float = 0.0) -> Table:
    """Return the proof of a document's bounds, from those that a search has found.

    ``apart_s``: the time that two events are at least apart, as the search has found it; 0: none.
    """
    found = [write_bound(document, bound) for bound in bounds]
    proof: Table = {"format": FORMAT, "document": "", "bounds": found}
    at_start = [edge for edge in document.dead_edges if edge["from"].startswith("start")]
    quiet = next(filter(None, (write_quiet_start(document, edge) for edge in at_start)), None)
    if quiet is not None:
        proof["lemmas"] = [quiet.lemma]
    levels = levels_of(bounds)
    if DRIFT in levels and compares_error(document.loop) and not document.model.sources:
        rows = ErrorRows(document, levels[DRIFT], quiet)
        has_bound = rows.are_throughout and ERROR not in document.output_names
        if document.model.errors is not None or has_bound:
            proof["rows"] = [*rows.entries()]
        if has_bound:
            document.add_output(ERROR)
            found.append(rows.bound())
    if times := [*EventTimes(document, levels).entries(apart_s)]:
        proof["times"] = times
    proof["document"] = hashlib.sha256(as_text(document.table).encode()).hexdigest()
    return proof


def as_text(table: Table) -> str:
    """Return the text of a file."""
    return json.dumps(table, ensure_ascii=False, separators=(",", ":"), allow_nan=False) + "\n"
