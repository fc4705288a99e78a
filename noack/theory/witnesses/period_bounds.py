"""The search for bounds of the outputs of a loop document without motions (R2 to R4 of the kernel).

Nothing here has to be right: the kernel verifies what is found. V = ζᵀPζ − d f1² with ζ = (states, f2) and a
P for each location obeys λV − V⁺ + Σ m q ⪰ 0 on each edge, with the λ by which f1² decays on it. Then V ≤ 0
stays so, and |y|² ≤ d f1² + D2² f2². Clarabel minimises d + weight · D2². During an edge the output is tested
at the ends of parts of its flows; what it may do between them enlarges the bound afterwards.
"""

from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from noack.core.linear_systems import Matrix
from noack.proof.numbers import above
from noack.proof.period_graph import (
    PeriodEdge,
    PeriodGraph,
    each_step,
    exact_value,
    float_rows,
    fraction_text,
)
from noack.proof.semidefinite import Accuracy, MatrixInequality, SolverAnswer, minimise

Entry = dict[str, Any]
_SOLVED = Accuracy(gap=1e-7, feasibility=1e-8, improves_steps=True)
_MARGIN = 1e-7
"""Of each inequality, in units in which the start and the output are near 1."""
_PARTS, _SOLVED_PARTS = 40, 8
"""Parts of an edge at whose ends the output is tested, and as many of them as Clarabel considers."""
_LEAST, _SIZE_WEIGHT = 1e-4, 1e-6
"""Least form, and weight of the largest one; without them the solver ends by rounding errors."""
_MOST_ENLARGED = 1.1
"""With a larger factor between the parts that were considered, all of them are."""
_ROUNDED = 1e-7
"""By so much, relatively, a bound is enlarged, so that rounding does not decide."""


class _TestedOutput(NamedTuple):
    """An output, in units in which the start and the output are near 1."""

    rows: Matrix
    size: float
    """The output is so many times what the rows give."""
    tested: Mapping[str, Sequence[Matrix]]
    """Its rows during edges, by the edges' names."""
    bends: Mapping[str, Sequence[Matrix]]
    """By how much the entries of the rows may differ on parts of flows from what is tested."""
    longest: Fraction
    """The longest part, s."""


class BoundSearch:
    """Looks for bounds of the outputs of a document, or of its part with some locations.

    Args:
        graph: the document in floating point.
    """

    def __init__(self, graph: PeriodGraph) -> None:
        self.graph, document = graph, graph.document
        columns = float_rows(document["start"]["columns"])
        self._place = graph.locations.index(document["start"]["location"])
        units = np.ones(graph.size)
        units[graph.states] = graph.units()
        sizes = np.abs(columns[graph.states, 0]) / units[graph.states]
        units[graph.states] *= float(sizes.max()) or 1.0
        forms = {name: self._fact(fact) for name, fact in document["facts"].items()}
        for i in graph.noise:  # as large as the facts allow, where f2 is 1
            allowed = [abs(float(np.diag(Q).min()) / Q[i, i]) for Q in forms.values() if Q[i, i] > 0]
            units[i] = max(allowed, default=1.0) ** 0.5 or 1.0
        self._units, self._scale = units, units[None, :] / units[:, None]
        self._start = columns[:, 0] / units
        self._facts = {name: Q * np.outer(units, units) for name, Q in forms.items()}
        self._fact_sizes = {name: float(np.abs(Q).max()) or 1.0 for name, Q in self._facts.items()}
        f2 = [] if graph.constant is None else [graph.constant]
        read = [edge.map[np.ix_(graph.states, f2 + graph.noise)] for edge in graph.edges]
        read += [float_rows(output["rows"])[:, f2 + graph.noise] for output in document["outputs"]]
        self._has_constant = bool(f2) and any(map(np.any, read))
        self._kept = [[*inside, *(f2 if self._has_constant else [])] for inside in graph.inside]

    def _fact(self, fact: Mapping[str, Sequence[str]]) -> Matrix:
        """Return Q of a fact zᵀQz ≤ 0."""
        named = {name: float_rows(rows) for name, rows in self.graph.document["rows"].items()}
        found = np.zeros((self.graph.size, self.graph.size))
        for side, sign in (("less", 1), ("more", -1)):
            for name in fact[side]:
                found += sign * named[name].T @ named[name]
        return found

    def bound(self, name: str, weight: float = 1.0) -> Entry | None:
        """Return the proof of a bound of an output; None: none was found.

        Args:
            name: of the output.
            weight: of the square of the part that does not decay, in the sum that is minimised.
        """
        problem = self._problem(name)
        for parts in (_SOLVED_PARTS, _PARTS):
            answer = self._solve(problem, weight, _PARTS // parts)
            found = [answer.matrices[str(place)] for place in range(len(self._kept))]
            if (answer.is_solved or answer.is_inaccurate) and all(np.isfinite(P).all() for P in found):
                chord, bent = self._sizes(problem, answer)
                if chord < _MOST_ENLARGED or (parts == _PARTS and np.isfinite(chord)):
                    return self._entry(name, problem, answer, chord, bent)
        return None

    def _problem(self, name: str) -> _TestedOutput:
        graph = self.graph
        (output,) = (each for each in graph.document["outputs"] if each["name"] == name)
        rows = float_rows(output["rows"]) * self._units
        size = float(np.linalg.norm(rows)) or 1.0
        lasting = [edge for edge in graph.edges if output.get("during_edges") and edge.duration > 0]
        longest = max((edge.duration for edge in lasting), default=Fraction(1)) / _PARTS
        tested, bends = {}, {}
        for edge in lasting:
            found = graph.during(edge, rows / size / self._units, longest)
            tested[edge.name] = [ends * self._units for ends, _ in found]
            bends[edge.name] = [bend * self._units for _, bend in found]
        return _TestedOutput(rows / size, size, tested, bends, longest)

    # The inequalities.

    def _decay(self, edge: PeriodEdge) -> float:
        """Return the factor by which f1² decays on an edge."""
        decaying = self.graph.decaying
        return 1.0 if decaying is None else float(edge.map[decaying, decaying]) ** 2

    def _solve(self, problem: _TestedOutput, weight: float, every: int) -> SolverAnswer:
        graph, found = self.graph, []
        for edge in graph.edges:
            on = [*self._kept[edge.source], *graph.noise]
            J = (edge.map * self._scale)[np.ix_(self._kept[edge.target], on)]
            one = np.eye(len(self._kept[edge.source]), len(on))
            parts = ((str(edge.source), self._decay(edge) * one / 2, one), (str(edge.target), -J / 2, J))
            nothing = np.zeros((len(on), len(on)))
            found.append(MatrixInequality(parts, self._multiplied("edge", edge, on), nothing))
            tested = problem.tested.get(edge.name, ())[::every]
            different = {rows.round(9).tobytes(): rows[:, on] for rows in tested}
            level = self._multiplied("during", edge, on) + self._level(on)
            before = ((str(edge.source), one / 2, one),)
            found += [MatrixInequality(before, level, -rows.T @ rows) for rows in different.values()]
        for place, kept in enumerate(self._kept):
            rows, one = problem.rows[:, kept], np.eye(len(kept))
            least = _LEAST * np.diag([float(i in graph.states) for i in kept])
            squares = -rows.T @ rows - least
            found.append(MatrixInequality(((str(place), one / 2, one),), self._level(kept), squares))
            found.append(MatrixInequality(((str(place), -one / 2, one),), (("size", one),), 0 * one))
        z = self._start[self._kept[self._place]][:, None]
        at_start = ((str(self._place), -z / 2, z),)
        found.append(MatrixInequality(at_start, (("d", np.eye(1)),), np.zeros((1, 1))))
        objective = {"d": 1.0, "size": _SIZE_WEIGHT} | ({"level": weight} if self._has_constant else {})
        return minimise(objective, found, margin=_MARGIN, accuracy=_SOLVED)

    def _multiplied(self, kind: str, edge: PeriodEdge, on: Sequence[int]) -> tuple[tuple[str, Matrix], ...]:
        return tuple(
            (_key(kind, edge, fact), self._facts[fact][np.ix_(on, on)] / self._fact_sizes[fact])
            for fact in edge.facts
        )

    def _level(self, on: Sequence[int]) -> tuple[tuple[str, Matrix], ...]:
        if not self._has_constant:
            return ()
        row = np.array([float(i == self.graph.constant) for i in on])
        return (("level", np.outer(row, row)),)

    # The entry of the proof.

    def _entry(
        self, name: str, problem: _TestedOutput, answer: SolverAnswer, chord: float, bent: float
    ) -> Entry:
        graph, numbers = self.graph, answer.numbers
        # All inequalities are linear in V, the levels and the multipliers, so that all of it may be enlarged.
        larger = (chord**0.5 + bent**0.5) ** 2 * (1 + _ROUNDED) * problem.size**2
        matrices, places = {}, {}
        for place, location in enumerate(graph.locations):
            kept = self._kept[place]
            P = answer.matrices[str(place)] * larger / np.outer(self._units[kept], self._units[kept])
            matrices[location] = ((P + P.T) / 2).tolist()
            terms = [{"matrix": location, "on": kept, "times": 1}]
            if graph.decaying is not None:
                terms.append({"matrix": "decaying", "on": [graph.decaying], "times": 1})
            places[location] = {"nodes": [0], "terms": [terms]}
        z = (self._start * self._units)[self._kept[self._place]]
        d = float(z @ np.array(matrices[graph.locations[self._place]]) @ z) * (1 + _ROUNDED)
        d = max(d, larger * _ROUNDED)
        lasting = [edge.duration for edge in graph.edges if edge.name in problem.tested]
        decayed = above(
            Fraction(
                d * float(np.exp(2 * float(graph.rate * max(lasting, default=Fraction(0))))) * (1 + 1e-12)
            )
        )
        constant = max(numbers["level"], 0.0) * larger if self._has_constant else 0.0
        multipliers: dict[str, Entry] = {}
        for edge in graph.edges:
            for kind, key in (("edge", f"edge/{edge.name}/0 0"), ("during", f"during/{edge.name}")):
                if edge.facts and (kind == "edge" or edge.name in problem.tested):
                    of_facts = {
                        fact: max(numbers.get(_key(kind, edge, fact), 0.0), 0.0) for fact in edge.facts
                    }
                    multipliers[key] = {
                        "facts": {fact: m * larger / self._fact_sizes[fact] for fact, m in of_facts.items()}
                    }
        entry: Entry = {
            "output": name,
            "from": "start",
            "decay": 0,
            "levels": [decayed, constant],
            "matrices": matrices | {"decaying": [[-d]]},
            "forms": places,
            "multipliers": multipliers,
            "factors": {edge.name: self._factor(edge) for edge in graph.edges},
        }
        if problem.tested:
            spread = (bent / chord) ** 0.5 if bent > 0 else 1.0
            entry |= {"sub_step": fraction_text(problem.longest), "spread": spread}
        if len(graph.locations) < len(graph.document["locations"]):
            entry["only"] = list(graph.locations)
        return entry

    def _factor(self, edge: PeriodEdge) -> str:
        """Return the exact factor by which f1² decays on an edge."""
        graph, factor = self.graph, Fraction(1)
        for step in each_step(edge.steps):
            if isinstance(step, str) and (i := graph.decaying) is not None:
                factor *= exact_value(graph.document["steps"][step]["matrix"][i][i])
        return fraction_text(factor**2)

    def _sizes(self, problem: _TestedOutput, answer: SolverAnswer) -> tuple[float, float]:
        """Return by how much V has to be enlarged: for what is tested, and for what is between."""
        chord = bent = 0.0
        for place, kept in enumerate(self._kept):
            rows = problem.rows[:, kept]
            chord = max(chord, _share(rows.T @ rows, self._sum(answer, place, kept, ())))
        for edge in self.graph.edges:
            on = [*self._kept[edge.source], *self.graph.noise]
            whole = self._sum(answer, edge.source, on, self._multiplied("during", edge, on))
            for found in problem.tested.get(edge.name, ()):
                rows = found[:, on]
                chord = max(chord, _share(rows.T @ rows, whole))
            for bend in problem.bends.get(edge.name, ()):
                sizes = np.abs(bend[:, on])
                beyond = (np.count_nonzero(sizes, axis=1)[:, None] * sizes**2).sum(axis=0)
                bent = max(bent, _share(np.diag(beyond), whole))
        return chord, bent

    def _sum(
        self, answer: SolverAnswer, place: int, on: Sequence[int], multiplied: Sequence[tuple[str, Matrix]]
    ) -> Matrix:
        """Return the matrix of V + D2² f2² + Σ m q."""
        found, count = np.zeros((len(on), len(on))), len(self._kept[place])
        found[:count, :count] = answer.matrices[str(place)]
        for name, M in (*multiplied, *self._level(on)):
            found += max(answer.numbers.get(name, 0.0), 0.0) * M
        return found


def _key(kind: str, edge: PeriodEdge, fact: str) -> str:
    return f"{kind}/{edge.name}/{fact}"


def _share(part: Matrix, whole: Matrix) -> float:
    """Return the least s for which s · whole ⪰ part; infinity: there is none."""
    try:
        root = cholesky(whole, lower=True)
    except np.linalg.LinAlgError:
        return np.inf
    half = solve_triangular(root, part, lower=True)
    return float(np.linalg.eigvalsh(solve_triangular(root, half.T, lower=True)).max())
