"""The part of a proof about times between events: how far the sensor's error grows after an event (rule R10).

The numbers are computed in floating point, with some room; the kernel verifies them.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
from flint import arb, arb_mat

from noack.core.balls import number
from noack.proof.elaborate.norms import growth
from noack.proof.loop_document import DRIFT, LoopDocument, Table
from noack.proof.numbers import as_written, quotient

_ROOM = 1 + 1e-5
"""Numbers are larger by this factor than computed in floating point."""
_SHARES = 1 - np.geomspace(0.5, 1e-4, 40)
"""Tried shares of the comparison, where a measurement has noise."""
_SPLITS = np.geomspace(1e-3, 1e3, 61)
_STEPS = 40
"""Of a bisection."""

Levels = tuple[float, float]
"""The numbers a and b of a bound (a² f1² + b² f2²)^½."""


class Excluded(NamedTuple):
    """How large We may become within a time, so that no event is possible, and the numbers that show it."""

    after: Levels
    reach: Levels
    split: float | None
    facts: Mapping[str, Fraction]
    above: Mapping[str, Fraction]


class EventTimes:
    """What a proof says of times between events.

    Args:
        document: the loop document.
        levels: proven bounds from the start on, by the names of outputs as the search has them.
    """

    def __init__(self, document: LoopDocument, levels: Mapping[str, Levels]) -> None:
        self._document, self._levels = document, levels
        self._noise = _Noise(document)
        G = document.error_matrix
        names = {"f1": ("event, level",), "f2": ("event, floor", "event")}
        self._facts = {
            unit: [name for name in of if name in document.facts and document.threshold_squared(name) > 0]
            for unit, of in names.items()
        }
        """Facts of an event with a threshold in a unit."""
        self._M = arb_mat([[arb(float(entry)) for entry in row] for row in G])

    def entries(self, apart_s: float) -> Iterator[Table]:
        """Yield the entries of a proof.

        Args:
            apart_s: a time within which, at most, no event follows another one; 0: none is stated.
        """
        if (drift := self._levels.get(DRIFT)) is None:
            return
        for edge in self._document.dead_edges:
            within_s = float(Fraction(str(edge["when"][1])))
            if not edge["from"].startswith("start") and (found := self._excluded(drift, within_s)):
                yield {
                    **self._entry(found, self._resets(edge["from"]), [edge["name"]]),
                    "never": [edge["name"]],
                }
        if (apart := self._least_apart(drift, apart_s)) is not None:
            within, found = apart
            events = [edge["name"] for edge in self._document.table["edges"] if self._is_counted(edge)]
            entry = self._entry(found, events, events)
            if self._noise.multipliers and not self._document.table["start"]["location"].startswith("start"):
                entry["multipliers"]["start"] = self._of_noise
            yield {**entry, "apart": within}

    def _is_counted(self, edge: Table) -> bool:
        """Return whether an edge is an event that leaves the loop where the mismatch has a bound."""
        is_live = edge.get("event", False) and edge["to"] is not None
        return bool(is_live) and not str(edge["to"]).startswith("start")

    @property
    def _of_noise(self) -> Table:
        """The multipliers that bound We where it is a noise."""
        return {"facts": {name: quotient(value) for name, value in self._noise.multipliers.items()}}

    def _resets(self, location: str) -> list[str]:
        """Return the edges into a location, which are events."""
        return [edge["name"] for edge in self._document.table["edges"] if edge["to"] == location]

    def _entry(self, found: Excluded, resets: Sequence[str], edges: Sequence[str]) -> Table:
        multipliers: dict[str, Table] = {}
        if self._noise.multipliers:
            multipliers |= {f"after/{name}": self._of_noise for name in resets}
        for name in edges:
            facts = {fact: quotient(value) for fact, value in found.facts.items()}
            above = {unit: quotient(value) for unit, value in found.above.items()}
            multipliers[f"edge/{name}"] = {"facts": facts, "above": above}
        entry: dict[str, Any] = {
            "output": self._document.output_names[DRIFT],
            "matrix": [[quotient(value) for value in row] for row in self._document.error_matrix],
            "after": [quotient(value) for value in self._noise.squares],
            "reach": [size * size for size in found.reach],
            "multipliers": multipliers,
        }
        return entry if found.split is None else {**entry, "split": found.split}

    def _least_apart(self, drift: Levels, most_s: float) -> tuple[float, Excluded] | None:
        """Return the longest time up to ``most_s`` in which no event follows another one; None: 0."""
        if not most_s > 0:
            return None
        if found := self._excluded(drift, most_s):
            return most_s, found
        low, high, best = 0.0, most_s, None
        for _ in range(_STEPS):
            middle = (low + high) / 2
            if found := self._excluded(drift, middle):
                low, best = middle, (middle, found)
            else:
                high = middle
            if high - low < 1e-4 * most_s:
                break
        return best

    def _excluded(self, drift: Levels, within_s: float) -> Excluded | None:
        """Return numbers that exclude an event within a time after another one; None: there are none."""
        rate = arb(self._document.rate)
        q = self._M.nrows()
        shifted = self._M + arb_mat(q, q, [rate * (i == j) for i in range(q) for j in range(q)])
        largest, total = (float(each.abs_upper()) * _ROOM for each in growth(shifted, number(within_s)))
        after = tuple(math.sqrt(value) * _ROOM for value in self._noise.squares)
        splits = [float(split) for split in _SPLITS] if any(after) else [None]
        for split in splits:
            reach = []
            for size, noise in zip(drift, after, strict=True):
                square = (total * size) ** 2
                if split is not None:
                    square = (1 + 1 / split) * square + (1 + split) * (largest * noise) ** 2
                reach.append(math.sqrt(square) * _ROOM)
            pair = reach[0], reach[1]
            if not self._facts["f1"]:  # f1 ≤ f2
                pair = 0.0, math.hypot(*pair)
            for share in _SHARES if any(after) else [1.0]:
                if numbers := self._numbers(pair, float(share)):
                    return Excluded((after[0], after[1]), pair, split, *numbers)
        return None

    def _numbers(
        self, reach: Levels, share: float
    ) -> tuple[Mapping[str, Fraction], Mapping[str, Fraction]] | None:
        """Return multipliers of an event's facts with a sum ``share``, and what is left over of each unit."""
        document, facts = self._document, self._facts
        units = [unit for unit in ("f1", "f2") if facts[unit]]
        least: dict[str, float] = {}
        for unit, size in zip(("f1", "f2"), reach, strict=True):
            needed = size * size + self._noise.needed(unit, share)
            if unit in units:
                least[unit] = needed / document.threshold_squared(facts[unit][0])
            elif needed > 0:
                return None
        room = share - sum(least.values())
        if not room > 1e-9 or not least:
            return None
        chosen = [as_written(least[unit] + room / len(units)) for unit in units[:-1]]
        last = as_written(share) - sum(chosen, Fraction())
        numbers = {facts[unit][0]: value for unit, value in zip(units, [*chosen, last], strict=True)}
        above = {
            unit: as_written(0.5 * room / len(units) * document.threshold_squared(facts[unit][0]))
            for unit in units
        }
        return numbers | self._noise.at_event(share), above


class _Noise:
    """W times the noise of a measurement: |WCp|² ≤ Σ m p², as the sums of rows of |CᵀWᵀWC| are."""

    def __init__(self, document: LoopDocument) -> None:
        names, C = document.noise_columns()
        G = np.abs(C.T @ C)
        sizes = [as_written(float(size) * _ROOM) for size in G.sum(axis=1)]
        self._sizes = {name: size for name, size in zip(names, sizes, strict=True) if size > 0}
        self._units = {name: document.facts[f"noise {name}"]["more"][0] for name in names}

    @property
    def multipliers(self) -> dict[str, Fraction]:
        """Those of the facts of noise, so that |WCp|² is at most ``squares``."""
        return {f"noise {name}": size for name, size in self._sizes.items()}

    @property
    def squares(self) -> tuple[Fraction, Fraction]:
        """N1² and N2²."""
        total = {"f1": Fraction(), "f2": Fraction()}
        for name, size in self._sizes.items():
            total[self._units[name]] += size * as_written(_ROOM)
        return total["f1"], total["f2"]

    def needed(self, unit: str, share: float) -> float:
        """Return what the noise of the event's own measurement takes of a unit."""
        numbers = self.at_event(share)
        return sum(float(numbers[f"noise {name}"]) for name in self._sizes if self._units[name] == unit)

    def at_event(self, share: float) -> dict[str, Fraction]:
        """Return multipliers k with |a|² − s |a − b|² + Σ k p² ⪰ 0 for b = WCp and a share s < 1."""
        if not self._sizes:
            return {}
        factor = as_written(share / (1 - share) * _ROOM)
        return {f"noise {name}": factor * size for name, size in self._sizes.items()}


def levels_of(bounds: Sequence[Mapping[str, Any]]) -> dict[str, Levels]:
    """Return the bounds from the start on that a search has found."""
    found = {}
    for bound in bounds:
        if bound.get("from_start", True):
            squares = [max(bound["numbers"].get(f"level {k}", 0.0), 0.0) for k in (1, 2)]
            found[str(bound["output"])] = math.sqrt(squares[0]), math.sqrt(squares[1])
    return found
