"""The part of a proof about the errors that a search assumes: bounds of We and Ww by norms (rule R11).

Between two tests We grows by the mismatch of the sensor's model. At a silent test it is at most the
threshold. With a held input Ww does not move, and an event adds We. The numbers are computed in floating
point, with some room; the kernel verifies them.
"""

import math
from collections.abc import Iterator, Mapping
from fractions import Fraction
from functools import cached_property
from typing import Any

import numpy as np
from flint import arb, arb_mat

from noack.core.balls import number
from noack.proof.elaborate.hybrid_system import thresholds
from noack.proof.elaborate.norms import growth
from noack.proof.event_times import Levels
from noack.proof.loop_document import BOUND_OF_E, BOUND_OF_W, DRIFT, ERROR, LoopDocument, Table
from noack.proof.numbers import Fractions, as_written, quotient, written
from noack.proof.quiet_start import NAME as QUIET
from noack.proof.quiet_start import QuietStart
from noack.proof.search.results import weighted

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
    """Bounds of We, and of Ww if the input is held and forms need it.

    Args:
        document: the loop document.
        drift: the proven bound of the mismatch.
        quiet: the lemma that no event comes before the first input; None: an input acts at once.
    """

    def __init__(self, document: LoopDocument, drift: Levels, quiet: QuietStart | None) -> None:
        self._document, self._drift, self._quiet = document, drift, quiet
        self._loop, errors = document.loop, document.model.errors
        self._most: Squares = (math.inf, math.inf)
        if errors is not None:
            self._most = float(errors.decaying) ** 2, float(errors.constant) ** 2
        self._needs_w = errors is not None and self._loop.holds
        level, floor = (float(size) for size in thresholds(self._loop, document.rate))
        self._threshold: Squares = level**2 * _ROOM, floor**2 * _ROOM
        self._places = [
            place for place in document.table["locations"] if not place["name"].startswith("start")
        ]
        self._edges = [edge for edge in document.table["edges"] if edge["to"] is not None]
        self._is_silent = {place["name"] for place in self._places if "silent" in place["facts"]}
        """Locations in which the trigger is tested at all times, so that We is at most the threshold."""

    def entries(self) -> Iterator[Table]:
        """Yield the entries of the proof; none if the errors grow beyond what is assumed."""
        if (of_e := self._of_e) is not None:
            if of_e["in"]:
                yield of_e
            if self._needs_w:
                yield self._of_w()

    @property
    def are_throughout(self) -> bool:
        """Whether We has a bound at all times, before the first input, too."""
        starts = [p for p in self._document.table["locations"] if p["name"].startswith("start")]
        is_quiet = self._quiet is not None and self._quiet.is_throughout and self._quiet.share > 0
        return self._of_e is not None and (is_quiet or not starts)

    # The sensor's error.

    @cached_property
    def _of_e(self) -> Table | None:
        """The bound of We; None: it would exceed what is assumed."""
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
                if edge["to"] in enter and (table := self._reason(edge))
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
            return self._threshold
        squares = within[edge["from"]][0]
        return squares[0] * _ROOM, squares[1] * _ROOM

    def _reason(self, edge: Table) -> Table | None:
        """Return the multipliers that prove the bound after an edge."""
        if edge.get("event"):
            return None
        if edge["from"].startswith("start"):
            return self._after_start()
        return {"facts": {"silent" if self._has_silent(edge) else BOUND_OF_E: 1}}

    def _has_silent(self, edge: Table) -> bool:
        """Return whether We is at most the threshold before an edge, since the trigger was silent."""
        return "silent" in edge["facts"] or edge["from"] in self._is_silent

    def _after_start(self) -> Table | None:
        """Return the multiplier of the lemma that no event comes before the first input.

        It says that We is below the threshold: P + Σ m q ⪰ 0 with the facts q of an event.
        """
        if self._quiet is None or not self._quiet.share > 0:
            return None
        return {"form": {"name": QUIET, "times": 1 / self._quiet.share}}

    def _grown(self, place: str, enter: Squares) -> tuple[Squares, float | None]:
        """Return the squares of a bound of We in a location, and the split that gives them."""
        (location,) = (each for each in self._places if each["name"] == place)
        largest, total = self._growth(float(Fraction(str(location["clock"]))))
        if not any(enter):
            return self._grown_by(0.0, total, enter), None
        found = {s: self._grown_by(largest, total, enter, float(s)) for s in _SPLITS}
        split = min(found, key=lambda s: self._size(found[s]))
        return found[split], float(split)

    def _grown_by(self, largest: float, total: float, enter: Squares, split: float = math.inf) -> Squares:
        """Return (1 + s) g² N² + (1 + 1/s) I² D² in both units; an infinite s is for N = 0."""
        grown = []
        for size, first in zip(self._drift, enter, strict=True):
            pushed = (1 + 1 / split) * (total * size) ** 2
            grown.append((pushed + ((1 + split) * largest**2 * first if first else 0.0)) * _ROOM**2)
        return grown[0], grown[1]

    def _size(self, squares: Squares) -> float:
        """Return what a split makes small: the largest share of what is assumed, or of the thresholds."""
        pairs = self._pairs(squares)
        if math.isinf(self._most[0]):
            pairs = [(most, least or 1.0) for (most, _), least in zip(pairs, self._threshold, strict=False)]
            return sum(most / least for most, least in pairs)
        return max(most / limit for most, limit in pairs)

    def _growth(self, within_s: float) -> tuple[float, float]:
        G: arb_mat = weighted(self._loop, arb(self._document.rate))
        largest, total = (float(each.abs_upper()) for each in growth(G, number(within_s)))
        return largest * _ROOM, total * _ROOM

    def bound(self) -> Table:
        """Return the proof's entry of the bound of We, which follows from its bounds in all locations.

        Before the first input the lemma bounds it by the threshold.
        """
        levels, multipliers, of_e = self._threshold, dict[str, Table](), self._of_e
        assert of_e is not None
        for place in self._places:
            name, fact = place["name"], "silent" if place["name"] in self._is_silent else BOUND_OF_E
            if fact == BOUND_OF_E:
                decaying, constant = of_e["in"][name]["within"]
                levels = _largest(levels, (decaying, constant))
            multipliers[f"output/{name}/0"] = {"facts": {fact: 1}}
        forms: dict[str, Table] = {place["name"]: {"nodes": [0], "terms": [[]]} for place in self._places}
        if self._quiet is not None:
            (start,) = (name for name in self._quiet.lemma["forms"] if name.startswith("start"))
            nodes = self._quiet.lemma["forms"][start]["nodes"]
            forms[start] = {"nodes": nodes, "terms": [[] for _ in nodes]}
            used = {"forms": {QUIET: 1 / self._quiet.share}}
            multipliers |= {f"output/{start}/piece {piece}": used for piece in range(len(nodes) - 1)}
        units = [self._document.has(unit) for unit in ("f1", "f2")]
        return {
            "output": self._document.output_names[ERROR],
            "from": "start",
            "decay": 0,
            "levels": [level * _ROOM if is_unit else 0 for level, is_unit in zip(levels, units, strict=True)],
            "matrices": {},
            "forms": forms,
            "multipliers": multipliers,
        }

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
