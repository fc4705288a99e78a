"""The lemma that no event follows the one at t = 0 before the first input acts (rules R1, R3 and R5).

Until then x moves as without an input, from a start that is known. A form P(θ) of the location, affine
between some times θ, is at most 0 there, and above 0 where an event is possible. A solver finds it.
"""

from collections.abc import Iterator, Sequence
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import expm

from noack.core.linear_systems import Matrix
from noack.proof.loop_document import LoopDocument, Table
from noack.proof.semidefinite import Accuracy, MatrixInequality, SolverAnswer, minimise

NAME = "no event before the first input"
_PIECES = (1, 4, 16)
"""Tried numbers of pieces of the clock."""
_ACCURACY = Accuracy(1e-9, 1e-9, improves_steps=True)
_MARGIN, _ENOUGH = 1e-7, 0.5
"""A margin of all inequalities, in units in which coordinates are about 1; the least ε that is a proof."""
_SMALL = 1e-3
"""A coordinate counts as at least this share of the largest one."""


class QuietStart(NamedTuple):
    """The lemma that no event comes before the first input."""

    lemma: Table
    """The proof's entry."""
    is_throughout: bool
    """An event is excluded at all times before the first input, not only at those of tests."""
    share: float
    """The sum of the multipliers of an event's facts: |We|² is at most the threshold's, plus V over this."""


def write_quiet_start(document: LoopDocument, edge: Table) -> QuietStart | None:
    """Return the lemma that an event before the first input is never taken; None: the solver finds none.

    Args:
        document: the loop document.
        edge: the event, which leads nowhere.
    """
    for throughout in (True, False):
        for pieces in _PIECES:
            problem = _StartProblem(document, edge, pieces, is_throughout=throughout)
            if (answer := problem.solve()) is not None:
                return QuietStart(problem.lemma(answer), throughout, problem.share(answer))
    return None


class _StartProblem:
    def __init__(self, document: LoopDocument, edge: Table, pieces: int, *, is_throughout: bool) -> None:
        self._document, self._edge, table = document, edge, document.table
        names = [entry["name"] for entry in table["coordinates"]]
        self._index = {name: index for index, name in enumerate(names)}
        self._size = len(names)
        (self._place,) = (place for place in table["locations"] if place["name"] == edge["from"])
        clock = Fraction(str(self._place["clock"]))
        self._nodes = [clock * k / pieces for k in range(pieces + 1)]
        first, last = (Fraction(str(end)) for end in edge["when"])
        self._at_edge = [
            k
            for k in range(pieces + 1)
            if (k == pieces or self._nodes[k + 1] > first) and (k == 0 or self._nodes[k - 1] < last)
        ]
        """Nodes that cover the times at which an event is possible."""
        self._excluded = range(pieces + 1) if is_throughout else self._at_edge
        units = [unit for unit in ("f1", "f2") if unit in self._index]
        self._units = units
        self._inside = sorted(self._index[name] for name in [*self._place["coordinates"], *units])
        self._noise = [self._index[entry["name"]] for entry in table["coordinates"] if entry.get("noise")]
        (self._corner,) = document.motions[self._place["motion"]]
        self._start = floats(table["start"]["columns"])
        self._facts = {name: self._fact(name) for name in edge["facts"]}
        self._scales = self._typical_sizes()

    def _fact(self, name: str) -> Matrix:
        """Return the matrix of a fact, which is ≤ 0."""
        entry, rows = self._document.facts[name], self._document.rows
        total = np.zeros((self._size, self._size))
        for sign, names in ((1.0, entry["less"]), (-1.0, entry["more"])):
            for each in names:
                R = floats(rows[each])
                total += sign * R.T @ R
        return total

    def _typical_sizes(self) -> Matrix:
        """Return about how large each coordinate is, without unknown signals."""
        F = floats(self._corner["matrix"])
        ends = [expm(F * float(node)) @ self._start for node in self._nodes]
        sizes = np.max([np.abs(end).sum(axis=1) for end in ends], axis=0)
        known = sizes[[i for i in self._inside if i not in self._noise]]
        least: Matrix = np.maximum(sizes, _SMALL * known.max())
        return least

    def solve(self) -> SolverAnswer | None:
        """Return matrices and numbers that prove the lemma; None: there are none."""
        at_most_1 = MatrixInequality((), (("above", -np.eye(1)),), np.eye(1))
        inequalities = [*self._motions(), self._at_start(), *self._at_events(), at_most_1]
        answer = minimise({"above": -1.0}, inequalities, margin=_MARGIN, accuracy=_ACCURACY)
        is_found = answer.is_solved and answer.numbers["above"] > _ENOUGH
        return answer if is_found else None

    def _motions(self) -> Iterator[MatrixInequality]:
        """Yield −(2 zᵀPż + zᵀP′z) + Σ τ(|p|² − |Rz|²) ⪰ 0 at both ends of each piece."""
        unknown = self._corner["unknown"]
        count = len(self._inside) + len(unknown)
        z = np.eye(len(self._inside), count)
        lift = np.zeros((self._size, count))
        lift[self._inside, range(len(self._inside))] = self._scales[self._inside]
        velocity = floats(self._corner["matrix"]) @ lift
        squares = []
        for k, signal in enumerate(unknown):
            R = floats(signal["rows"]) @ lift
            size = float(np.abs(R).max()) or 1.0
            velocity[:, len(self._inside) + k] += size * floats(signal["column"])[:, 0]
            square = np.zeros((count, count))
            square[len(self._inside) + k, len(self._inside) + k] = 1.0
            squares.append(square - R.T @ R / size**2)
        moved = velocity[self._inside] / self._scales[self._inside, None]
        length = float(self._nodes[1])
        for piece in range(len(self._nodes) - 1):
            slope = (f"P{piece + 1}", -z / (2 * length), z), (f"P{piece}", z / (2 * length), z)
            for node in (piece, piece + 1):
                scalars = tuple((f"signal {node}/{k}", square) for k, square in enumerate(squares))
                # in units of the time that a piece takes
                parts = tuple((name, length * L, R) for name, L, R in ((f"P{node}", -z, moved), *slope))
                yield MatrixInequality(parts, scalars, np.zeros((count, count)))

    def _at_start(self) -> MatrixInequality:
        """Return −z(0)ᵀPz(0) + Σ m q ⪰ 0."""
        Z = self._start[self._inside] / self._scales[self._inside, None]
        whole = self._start
        facts = self._document.table["start"]["facts"]
        scalars = tuple((f"start {name}", whole.T @ self._fact(name) @ whole) for name in facts)
        return MatrixInequality((("P0", -Z / 2, Z),), scalars, np.zeros((Z.shape[1], Z.shape[1])))

    def _at_events(self) -> Iterator[MatrixInequality]:
        """Yield zᵀPz + Σ m q − ε Σ f² ⪰ 0 at the nodes."""
        kept = [*self._inside, *self._noise]
        scales = self._scales[kept]
        scales[len(self._inside) :] = 1.0
        z = np.eye(len(self._inside), len(kept))
        units = np.diag([float(i in [self._index[unit] for unit in self._units]) for i in kept])
        sizes = {
            name: max(float(np.abs(self._scaled(Q, kept, scales)).max()), 1e-300)
            for name, Q in self._facts.items()
        }
        scalars = tuple(
            (f"event {name}", self._scaled(Q, kept, scales) / sizes[name]) for name, Q in self._facts.items()
        )
        for node in self._excluded:
            parts = ((f"P{node}", z / 2, z),)
            yield MatrixInequality(parts, (*scalars, ("above", -units)), np.zeros((len(kept), len(kept))))

    def _scaled(self, Q: Matrix, kept: Sequence[int], scales: Matrix) -> Matrix:
        return Q[np.ix_(kept, kept)] * np.outer(scales, scales)

    # The lemma.

    def share(self, answer: SolverAnswer) -> float:
        """Return the sum of the multipliers of an event's facts."""
        return sum(value for fact, value in self._of_event(answer).items() if not fact.startswith("noise "))

    def _of_event(self, answer: SolverAnswer) -> dict[str, float]:
        numbers = {fact: max(answer.numbers.get(f"event {fact}", 0.0), 0.0) for fact in self._facts}
        return {fact: number / self._size_of(fact) for fact, number in numbers.items()}

    def lemma(self, answer: SolverAnswer) -> Table:
        """Return the proof's entry."""
        scales, name = self._scales[self._inside], self._edge["from"]
        matrices = {key: (P / np.outer(scales, scales)).tolist() for key, P in answer.matrices.items()}
        terms = [[{"matrix": f"P{k}", "on": self._inside, "times": 1}] for k in range(len(self._nodes))]
        nodes = [str(node) if node.denominator > 1 else int(node) for node in self._nodes]
        nothing: Table = {"nodes": [0], "terms": [[]]}
        forms = {place["name"]: nothing for place in self._document.table["locations"]}
        return {
            "name": NAME,
            "decay": 0,
            "factors": {edge["name"]: 0 for edge in self._document.table["edges"] if self._leaves(edge)},
            "matrices": matrices,
            "forms": forms | {name: {"nodes": nodes, "terms": terms}},
            "multipliers": dict(self._multipliers(answer)),
        }

    def _leaves(self, edge: Table) -> bool:
        """Return whether the first input acts at an edge: then nothing is left of the form."""
        return bool(edge["from"] == self._edge["from"]) and edge["to"] is not None

    def _multipliers(self, answer: SolverAnswer) -> Iterator[tuple[str, Table]]:
        name, numbers = self._edge["from"], answer.numbers
        length = float(self._nodes[1])
        for node in range(len(self._nodes)):
            signals = [
                value
                for k, signal in enumerate(self._corner["unknown"])
                for value in self._signal(signal, max(numbers.get(f"signal {node}/{k}", 0.0), 0.0) / length)
            ]
            if signals:
                yield f"motion/{name}/{node}", {"unknown": signals}
        for node in self._at_edge:
            facts = self._of_event(answer)
            above = {
                unit: numbers["above"] / 2 / self._scales[self._index[unit]] ** 2 for unit in self._units
            }
            yield f"edge/{self._edge['name']}/{node}", {"facts": facts, "above": above}
        facts = {
            fact: max(numbers.get(f"start {fact}", 0.0), 0.0)
            for fact in self._document.table["start"]["facts"]
        }
        if any(facts.values()):
            yield "start", {"facts": facts}

    def _size_of(self, fact: str) -> float:
        kept = [*self._inside, *self._noise]
        scales = self._scales[kept]
        scales[len(self._inside) :] = 1.0
        return max(float(np.abs(self._scaled(self._facts[fact], kept, scales)).max()), 1e-300)

    def _signal(self, signal: Table, number: float) -> list[float]:
        """Return the multiplier of a signal, which the solver has in units of its largest row."""
        lift = np.zeros((self._size, len(self._inside)))
        lift[self._inside, range(len(self._inside))] = self._scales[self._inside]
        size = float(np.abs(floats(signal["rows"]) @ lift).max()) or 1.0
        return [number / size**2, *([0.0] if "along" in signal else [])]


def floats(rows: Sequence[Sequence[Any]]) -> Matrix:
    """Return a matrix of a document, in floating point; of an interval its middle."""

    def value(entry: Any) -> float:
        if isinstance(entry, list):
            return (value(entry[0]) + value(entry[1])) / 2
        return float(Fraction(str(entry)))

    return np.array([[value(entry) for entry in row] for row in rows])
