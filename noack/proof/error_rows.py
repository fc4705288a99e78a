"""The part of a proof about the errors that a search assumes: bounds of We and Ww by norms (rule R11).

Between two tests We grows by the mismatch of the sensor's model. At a silent test it is at most the
threshold. With a held input Ww does not move, and an event adds We. The numbers are computed in floating
point, with some room; the kernel verifies them.
"""

from collections.abc import Iterator, Mapping
from fractions import Fraction
from typing import Any

import numpy as np
from flint import arb, arb_mat

from noack.proof.event_times import Levels
from noack.proof.loop_document import BOUND_OF_E, BOUND_OF_W, DRIFT, LoopDocument, Table
from noack.proof.numbers import Fractions, as_written, quotient, written
from noack.proof.quiet_start import NAME as QUIET
from noack_check.balls import number
from noack_check.norms import growth
from noack_check.proof import weighted

_ROOM = 1 + 1e-6
"""Numbers are larger by this factor than computed in floating point."""
_STEP = 1e-9
"""Of the bounds of Ww: by so much more for each missing update."""
_SPLITS = np.geomspace(1e-3, 1e3, 121)
_ROUNDS = 12
"""Through all edges, until no bound at an entry grows."""

Squares = tuple[float, float]
"""The squares a² and b² of a bound (a² f1² + b² f2²)^½."""


class ErrorRows:
    """Bounds of We, and of Ww if the input is held.

    Args:
        document: the loop document.
        drift: the proven bound of the mismatch.
        lemmas: of the proof.
    """

    def __init__(self, document: LoopDocument, drift: Levels, lemmas: list[Table]) -> None:
        self._document, self._drift = document, drift
        self._loop, errors = document.loop, document.model.errors
        assert errors is not None
        self._most: Squares = float(errors.decaying) ** 2, float(errors.constant) ** 2
        self._quiet = next((lemma for lemma in lemmas if lemma["name"] == QUIET), None)
        self._places = [
            place for place in document.table["locations"] if not place["name"].startswith("start")
        ]
        self._edges = [edge for edge in document.table["edges"] if edge["to"] is not None]
        self._is_silent = {place["name"] for place in self._places if "silent" in place["facts"]}
        """Locations in which the trigger is tested at all times, so that We is at most the threshold."""

    def entries(self) -> Iterator[Table]:
        """Yield the entries of the proof; none if the errors grow beyond what is assumed."""
        if (of_e := self._of_e()) is not None:
            if of_e["in"]:
                yield of_e
            if self._loop.holds:
                yield self._of_w()

    # The sensor's error.

    def _of_e(self) -> Table | None:
        """Return the bound of We."""
        names = [place["name"] for place in self._places if place["name"] not in self._is_silent]
        enter: dict[str, Squares] = dict.fromkeys(names, (0.0, 0.0))
        within = {name: self._grown(name, squares) for name, squares in enter.items()}
        for _ in range(_ROUNDS):
            before = dict(enter)
            for edge in self._edges:
                if edge["to"] in enter and (squares := self._entered(edge, within)) is not None:
                    enter[edge["to"]] = _largest(enter[edge["to"]], squares)
            within = {name: self._grown(name, squares) for name, squares in enter.items()}
            if enter == before:
                break
        if any(not most < limit for pair in within.values() for most, limit in self._pairs(pair[0])):
            return None
        return {
            "name": BOUND_OF_E,
            "rows": written(self._document.error_rows),
            "matrix": written(self._document.error_matrix),
            "output": self._document.output_names[DRIFT],
            "in": {name: _within(enter[name], *within[name]) for name in enter},
            "multipliers": {
                f"edge/{edge['name']}": table
                for edge in self._edges
                if edge["to"] in enter and (table := self._reason(edge, enter[edge["to"]]))
            },
        }

    def _pairs(self, squares: Squares) -> list[tuple[float, float]]:
        """Return the squares of units that the document has, with their limits."""
        units = zip(("f1", "f2"), squares, self._most, strict=True)
        return [(most, limit) for unit, most, limit in units if self._document.has(unit)]

    def _entered(self, edge: Table, within: Mapping[str, tuple[Squares, float | None]]) -> Squares | None:
        """Return the squares of a bound of We after an edge; None: it is 0."""
        if edge.get("event"):
            return None
        if edge["from"].startswith("start") or self._has_silent(edge):
            level, floor = float(self._document.model.level), float(self._document.model.floor)
            return level**2 * _ROOM, floor**2 * _ROOM
        squares = within[edge["from"]][0]
        return squares[0] * _ROOM, squares[1] * _ROOM

    def _reason(self, edge: Table, enter: Squares) -> Table | None:
        """Return the multipliers that prove the bound after an edge."""
        if edge.get("event"):
            return None
        if edge["from"].startswith("start"):
            return self._after_start(enter)
        return {"facts": {"silent" if self._has_silent(edge) else BOUND_OF_E: 1}}

    def _has_silent(self, edge: Table) -> bool:
        """Return whether We is at most the threshold before an edge, since the trigger was silent."""
        return "silent" in edge["facts"] or edge["from"] in self._is_silent

    def _after_start(self, enter: Squares) -> Table | None:
        """Return the multiplier of the lemma that no event comes before the first input.

        It says that We is below the threshold: P + Σ m q ⪰ 0 with the facts q of an event.
        """
        if self._quiet is None:
            return None
        numbers = [
            sum(float(Fraction(str(value))) for value in table["facts"].values())
            for name, table in self._quiet["multipliers"].items()
            if name.startswith("edge/") and "above" in table
        ]
        return {"form": {"name": QUIET, "times": 1 / max(numbers)}} if min(numbers) > 0 else None

    def _grown(self, place: str, enter: Squares) -> tuple[Squares, float | None]:
        """Return the squares of a bound of We in a location, and the split that gives them."""
        (location,) = (each for each in self._places if each["name"] == place)
        largest, total = self._growth(float(Fraction(str(location["clock"]))))
        if not any(enter):
            return tuple((total * size * _ROOM) ** 2 * _ROOM for size in self._drift), None  # type: ignore[return-value]
        best = None
        for split in map(float, _SPLITS):
            squares = tuple(
                ((1 + 1 / split) * (total * size) ** 2 + (1 + split) * largest**2 * first) * _ROOM**2
                for size, first in zip(self._drift, enter, strict=True)
            )
            shares = [most / limit for most, limit in self._pairs(squares)]  # type: ignore[arg-type]
            if best is None or max(shares) < best[0]:
                best = max(shares), squares, split
        assert best is not None
        return best[1], best[2]  # type: ignore[return-value]

    def _growth(self, within_s: float) -> tuple[float, float]:
        G: arb_mat = weighted(self._loop, arb(self._document.rate))
        largest, total = (float(each.abs_upper()) for each in growth(G, number(within_s)))
        return largest * _ROOM, total * _ROOM

    # What the acting input lacks.

    def _of_w(self) -> Table:
        """Return the bound of Ww: in "j lost" of j We, in "k later" of as many as may be missing."""
        missing = {place["name"]: self._missing(place["name"]) for place in self._places}
        rows = self._loop.weight * self._document.model.w
        W: Fractions = [
            [as_written(float(rows[i, c].mid())) for c in self._document.used] for i in range(rows.nrows())
        ]
        zeros = [[0] * len(W) for _ in W]
        bounds = {name: tuple(self._after(count)) for name, count in missing.items()}
        return {
            "name": BOUND_OF_W,
            "rows": written(W),
            "matrix": zeros,
            "in": {name: {"enter": [*squares], "within": [*squares]} for name, squares in bounds.items()},
            "multipliers": {
                f"edge/{edge['name']}": table
                for edge in self._edges
                if edge["to"] in missing and (table := self._added(edge, missing))
            },
        }

    def _missing(self, place: str) -> int:
        count = int(place.split(" ")[0])
        return count if place.endswith(" lost") else self._loop.losses + 1 + count

    def _after(self, missing: int) -> Iterator[float]:
        for square in self._most:
            yield missing**2 * square * (1 + _STEP * 3 * missing)

    def _added(self, edge: Table, missing: Mapping[str, int]) -> Table | None:
        """Return multipliers of |w + e|² ≤ (1 + 1/j)|w|² + (1 + j)|e|² where an event adds e."""
        if edge["from"].startswith("start") or missing[edge["to"]] == 0:  # Ww becomes 0
            return None
        before, room = missing[edge["from"]], 1 + _STEP
        if not edge.get("event"):
            return {"facts": {BOUND_OF_W: 1}} if edge["from"] == edge["to"] else None
        of_e = "silent" if edge["from"] in self._is_silent else BOUND_OF_E
        if before == 0:
            return {"facts": {of_e: room}}
        return {"facts": {BOUND_OF_W: room * (1 + 1 / before), of_e: room * (1 + before)}}


def _within(enter: Squares, within: Squares, split: float | None) -> dict[str, Any]:
    found = {"enter": [*enter], "within": [*within]}
    return found if split is None else found | {"split": quotient(as_written(split))}


def _largest(one: Squares, other: Squares) -> Squares:
    return max(one[0], other[0]), max(one[1], other[1])
