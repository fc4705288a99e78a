"""A loop document without motions in floating point: its locations, and the maps of its edges.

Nothing here has to be right: the kernel computes the maps again, in balls.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from scipy.linalg import expm

from noack.core.linear_systems import Matrix, Vector, balancing_exponents

Table = Mapping[str, Any]
_LARGEST = 1e150
"""Entry of a map, so that its square is a double."""


@dataclass(frozen=True)
class PeriodEdge:
    """An edge between two locations, which have numbers."""

    name: str
    source: int
    target: int
    map: Matrix
    """z := map z, (size, size); noise keeps its value during the edge."""
    duration: Fraction
    """In s."""
    facts: tuple[str, ...]
    steps: Sequence[Any]
    """As the document has them."""


class PeriodGraph:
    """The maps of a document, or of its part with some locations.

    Args:
        document: the table of a document in which no location has a motion.
        only: names of locations; None: all.
    """

    def __init__(self, document: Table, only: Sequence[str] | None = None) -> None:
        self.document = document
        self.names = [coordinate["name"] for coordinate in document["coordinates"]]
        self.size = len(self.names)
        self.noise = [i for i, c in enumerate(document["coordinates"]) if c.get("noise")]
        decaying = document.get("decaying") or {}
        self.decaying, self.constant = (
            None if unit is None else self.names.index(unit)
            for unit in (decaying.get("coordinate"), document.get("constant"))
        )
        self.rate = exact_value(decaying.get("rate", 0))
        still = {*self.noise, self.decaying, self.constant}
        self.states = [i for i in range(self.size) if i not in still]
        """Coordinates without units and noise."""
        kept = [each for each in document["locations"] if only is None or each["name"] in only]
        self.locations = [each["name"] for each in kept]
        self.inside = [sorted({self.names.index(c) for c in each["coordinates"]} - still) for each in kept]
        """The states of each location; the others are 0 there."""
        self._matrices = {name: float_rows(step["matrix"]) for name, step in document["steps"].items()}
        self._flows: dict[tuple[str, Fraction], Matrix] = {}
        self._products: dict[str, Matrix] = {}
        places = {name: number for number, name in enumerate(self.locations)}
        self.edges = [
            self._edge(edge, places[edge["from"]], places[edge["to"]])
            for edge in document["edges"]
            if edge["from"] in places and edge["to"] in places
        ]

    def _edge(self, edge: Table, source: int, target: int) -> PeriodEdge:
        duration = exact_value(edge.get("duration", 0))
        facts, steps = tuple(edge["facts"]), edge["jump"]
        return PeriodEdge(edge["name"], source, target, self._product(steps), duration, facts, steps)

    def _product(self, steps: Sequence[Any]) -> Matrix:
        key = repr(steps)
        if key not in self._products:
            found = np.eye(self.size)
            with np.errstate(over="ignore", invalid="ignore"):
                for step in steps:
                    found = self.step_map(step) @ found
            self._products[key] = found
        return self._products[key]

    def step_map(self, step: Any) -> Matrix:
        """Return the map of a step of an edge, or of repeated steps."""
        if isinstance(step, str):
            return self._matrices[step]
        if "repeat" in step:
            with np.errstate(over="ignore", invalid="ignore"):
                return np.linalg.matrix_power(self._product(step["repeat"]), step["times"])
        return self.flow(step["exp"], exact_value(step["seconds"]))

    def flow(self, name: str, seconds: Fraction) -> Matrix:
        """Return e^{Fs}."""
        key = name, seconds
        if key not in self._flows:
            self._flows[key] = np.asarray(expm(self._matrices[name] * float(seconds)))
        return self._flows[key]

    def rows(self, name: str) -> Matrix:
        """Return the rows of an output."""
        (output,) = (each for each in self.document["outputs"] if each["name"] == name)
        return float_rows(output["rows"])

    def during(self, edge: PeriodEdge, rows: Matrix, longest: Fraction) -> list[tuple[Matrix, Matrix]]:
        """Return an output's rows at the ends of all parts of an edge's flows, and their largest bends.

        Args:
            edge: the edge.
            rows: C in y = C z.
            longest: the longest part of a flow, s.
        """
        found, before = [], np.eye(self.size)
        for step in each_step(edge.steps):
            if not isinstance(step, str) and (seconds := exact_value(step["seconds"])) > 0:
                parts = -(-seconds // longest)
                F, part = self._matrices[step["exp"]], float(seconds / parts)
                over, at = self.flow(step["exp"], seconds / parts), before
                bend = np.abs(rows @ F @ F) @ expm(np.abs(F) * part) * part**2 / 8
                found.append((rows @ at, bend @ np.abs(at)))
                for _ in range(parts):
                    at = over @ at
                    found.append((rows @ at, bend @ np.abs(at)))
            before = self.step_map(step) @ before
        return found

    def units(self) -> Vector:
        """Return sizes of the states in which the maps have similar rows and columns, (states,)."""
        sizes = sum(np.abs(edge.map[np.ix_(self.states, self.states)]) for edge in self.edges)
        sizes = np.asarray(sizes, float)
        if not (np.isfinite(sizes).all() and sizes.max(initial=0.0) < _LARGEST):
            raise OverflowError
        return np.ldexp(1.0, -balancing_exponents(sizes))


def each_step(steps: Sequence[Any]) -> Iterator[Any]:
    """Yield the steps of an edge in order of time, the repeated ones again and again."""
    for step in steps:
        if isinstance(step, str) or "repeat" not in step:
            yield step
        else:
            for _ in range(step["times"]):
                yield from step["repeat"]


def exact_value(value: Any) -> Fraction:
    """Return a number of a document."""
    return Fraction(value) if isinstance(value, str | int) else Fraction(repr(value))


def fraction_text(value: Fraction) -> str:
    """Return a number as a document has it."""
    return f"{value.numerator}/{value.denominator}"


def float_rows(rows: Sequence[Sequence[Any]]) -> Matrix:
    """Return a matrix of a document; of an interval its middle."""

    def entry(value: Any) -> float:
        if isinstance(value, list):
            return sum(map(entry, value)) / 2
        return float(exact_value(value))

    return np.array([[entry(value) for value in row] for row in rows], float)
