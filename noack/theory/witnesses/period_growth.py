"""The search for proofs of the growth of a loop document without motions (R8 of the kernel).

Nothing here has to be right: the kernel verifies what is found.

1. *At least*: of all paths of each length those with the largest products are continued, and the cycle with
   the largest growth is kept.
2. *At most*: Clarabel looks for a quadratic form of each location with the smallest violation of
   g^{2T/U} P − JᵀP⁺J ⪰ 0. The kernel adds edges to a path until its product obeys the inequality, so a
   violation need not be 0.
"""

from collections.abc import Sequence
from fractions import Fraction
from functools import cached_property, reduce
from math import gcd
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from noack.core.linear_systems import Matrix, Stack, Vector
from noack.proof.period_graph import PeriodEdge, PeriodGraph, fraction_text
from noack.theory.time_triggered.graph import Graph
from noack.theory.witnesses.semidefinite import Accuracy, MatrixInequality, minimise

Entry = dict[str, Any]
_SOLVED = Accuracy(gap=1e-5, feasibility=1e-7, improves_steps=False)
_LEVEL_WEIGHT = 1e-6
"""Weight of the largest entry of the forms in their search, relative to what they violate."""
_BEAM, _LEAST_BEAM, _MOST_MULTIPLICATIONS = 300, 20, 1e7
"""Paths that are continued; fewer if the products of a length take more multiplications."""
_CYCLE_EDGES, _MOST_BURSTS = 40, 1500
"""Edges of the longest cycle, and paths between two locations that replace single edges."""
_LONGEST_PATH, _MOST_PRODUCTS = 20, 6000
"""Fewer than the kernel's limits."""
_BELOW = 1e-6
"""By so much less than the growth of a cycle, relatively, a proof claims."""
_DIGITS = 9
"""Of a factor, after the point."""


class Cycle(NamedTuple):
    """Edges that lead back to their beginning."""

    growth: float
    """Of the state per period."""
    edges: tuple[PeriodEdge, ...]


class GrowthSearch:
    """Looks for the growth of a document, or of its part with some locations.

    Args:
        graph: the document in floating point.
        period: the durations of all edges are multiples of it, s.
    """

    def __init__(self, graph: PeriodGraph, period: Fraction | None = None) -> None:
        self.graph = graph
        self.period = period or common_period(graph)
        self._units = graph.units()
        n = len(graph.states)
        scale = self._units[None, :] / self._units[:, None]
        maps = [edge.map[np.ix_(graph.states, graph.states)] * scale for edge in graph.edges]
        self._maps = np.array(maps).reshape(len(maps), n, n)
        periods = [int(edge.duration / self.period) for edge in graph.edges]
        self._periods = np.array(periods, np.int64)
        self._kept = [[graph.states.index(i) for i in inside] for inside in graph.inside]

    @cached_property
    def cycle(self) -> Cycle | None:
        """The cycle with the largest growth that was found; None: no state grows or decays in one."""
        paths = self._bursts() or [(number,) for number in range(len(self._maps))]
        edges = self.graph.edges
        maps = np.array([reduce(lambda M, k: self._maps[k] @ M, path, np.eye(self._maps.shape[1]))
                         for path in paths])  # fmt: skip
        nodes = {place: k for k, place in enumerate(dict.fromkeys(edges[path[0]].source for path in paths))}
        graph = Graph(
            np.array([nodes[edges[path[0]].source] for path in paths]),
            np.array([nodes[edges[path[-1]].target] for path in paths]),
            np.array([self._periods[list(path)].sum() for path in paths]),
        )
        work = max(map(len, graph.leaving)) * maps.shape[1] ** 3
        beam = max(min(_BEAM, int(_MOST_MULTIPLICATIONS / work)), _LEAST_BEAM)
        T = graph.balancing(maps)
        balanced = T[graph.targets] @ maps @ np.linalg.inv(T)[graph.sources]
        growth, cycle = graph.fastest_cycle(balanced, max(_CYCLE_EDGES, graph.nodes + 4), beam)
        if not cycle:
            return None
        return Cycle(float(np.exp(growth)), tuple(edges[k] for number in cycle for k in paths[number]))

    def _bursts(self) -> list[tuple[int, ...]]:
        """Return paths between locations that are reached from several ones; none if they are too many."""
        edges = self.graph.edges
        sources: dict[int, set[int]] = {}
        for edge in edges:
            sources.setdefault(edge.target, set()).add(edge.source)
        leaving: dict[int, list[int]] = {}
        for number, edge in enumerate(edges):
            leaving.setdefault(edge.source, []).append(number)
        kept = {place for place in leaving if len(sources.get(place, ())) > 1}
        found, pending = (
            list[tuple[int, ...]](),
            [tuple[int, ...]([k]) for place in sorted(kept) for k in leaving[place]],
        )
        while pending:
            path = pending.pop(0)
            if (end := edges[path[-1]].target) in kept:
                found.append(path)
            else:
                pending += [(*path, k) for k in leaving.get(end, ())]
            if len(found) + len(pending) > _MOST_BURSTS or len(path) > len(leaving):
                return []
        return found

    def at_least(self, cycle: Cycle) -> Entry | None:
        """Return the proof that a cycle grows nearly by its growth."""
        factor = np.floor(cycle.growth * (1 - _BELOW) * 10**_DIGITS) / 10**_DIGITS
        if not factor > 0:
            return None
        numbers = [self.graph.edges.index(edge) for edge in cycle.edges]
        product = reduce(lambda M, k: self._maps[k] @ M, numbers, np.eye(self._maps.shape[1]))
        least = float(factor) ** int(self._periods[numbers].sum())
        entry: Entry = {"factor": float(factor), "period": fraction_text(self.period)}
        entry["cycle"] = [edge.name for edge in cycle.edges]
        values, vectors = np.linalg.eig(product)
        largest = int(np.argmax(np.abs(values)))
        if abs(values[largest].imag) < _BELOW * abs(values[largest]):
            return entry | {"sign": "positive" if values[largest].real > 0 else "negative"}
        A = product / least
        try:
            P = -solve_discrete_lyapunov(A.T, np.eye(len(A)))
        except np.linalg.LinAlgError:
            return None
        v = max((vectors[:, largest].real, vectors[:, largest].imag), key=lambda v: float(v @ P @ v))
        size = float(np.abs(P).max())
        form = P / size / np.outer(self._units, self._units)
        return entry | {"form": symmetric_rows(form), "vector": [[float(x)] for x in v * self._units]}

    def at_most(self, growth: float) -> Entry | None:
        """Return the proof that nothing grows faster than by a factor per period, if forms are found."""
        factor = np.ceil(growth * 10**_DIGITS) / 10**_DIGITS
        forms = self._forms(factor ** self._periods.astype(float))
        if forms is None or not self._paths_end(forms, float(factor)):
            return None
        rows = {}
        for name, P, kept in zip(self.graph.locations, forms, self._kept, strict=True):
            rows[name] = symmetric_rows(P / np.outer(self._units[kept], self._units[kept]))
        entry = {"factor": float(factor), "period": fraction_text(self.period), "forms": rows}
        if len(self.graph.locations) < len(self.graph.document["locations"]):
            entry["only"] = list(self.graph.locations)
        return entry

    def _forms(self, growths: Vector) -> list[Matrix] | None:
        """Return forms with P − JᵀP⁺J/g² ⪰ −s for the smallest s; None: the solver fails."""
        problem = []
        for place, kept in enumerate(self._kept):
            one = np.eye(len(kept))
            problem.append(MatrixInequality(((str(place), one / 2, one),), (), -one))
            problem.append(MatrixInequality(((str(place), -one / 2, one),), (("level", one),), 0 * one))
        for edge, M, growth in zip(self.graph.edges, self._maps, growths, strict=True):
            J = M[np.ix_(self._kept[edge.target], self._kept[edge.source])] / growth
            one = np.eye(J.shape[1])
            parts = ((str(edge.source), one / 2, one), (str(edge.target), -J / 2, J))
            problem.append(MatrixInequality(parts, (("violation", one),), 0 * one))
        objective = {"violation": 1.0, "level": _LEVEL_WEIGHT}
        answer = minimise(objective, problem, margin=0.0, accuracy=_SOLVED)
        forms = [answer.matrices[str(place)] for place in range(len(self._kept))]
        return forms if all(np.isfinite(P).all() for P in forms) else None

    def _paths_end(self, forms: Sequence[Matrix], factor: float) -> bool:
        """Return whether every path has a beginning that grows by less than the factor."""
        n = self._maps.shape[1]
        T, inverse = np.zeros((len(forms), n, n)), np.zeros((len(forms), n, n))
        for place, (P, kept) in enumerate(zip(forms, self._kept, strict=True)):
            try:
                root = np.linalg.cholesky(P).T
            except np.linalg.LinAlgError:
                return False
            T[place][np.ix_(kept, kept)] = root
            inverse[place][np.ix_(kept, kept)] = np.linalg.inv(root)
        sources, targets = (
            np.array([getattr(edge, end) for edge in self.graph.edges]) for end in ("source", "target")
        )
        growths = factor ** self._periods.astype(float)
        steps: Stack = T[targets] @ self._maps @ inverse[sources] / growths[:, None, None]
        leaving = [np.flatnonzero(sources == place) for place in range(len(forms))]
        ends, products, count = targets, steps, 0
        for _ in range(_LONGEST_PATH):
            grows = ~(np.linalg.norm(products, 2, axis=(1, 2)) < 1 - 1e-12)
            if not grows.any():
                return True
            ends, products = ends[grows], products[grows]
            step = np.concatenate([leaving[end] for end in ends])
            count += len(step)
            if count > _MOST_PRODUCTS:
                return False
            products = steps[step] @ np.repeat(products, [len(leaving[end]) for end in ends], axis=0)
            ends = targets[step]
        return False


def common_period(graph: PeriodGraph) -> Fraction:
    """Return the longest time of which the durations of all edges are multiples, s."""
    found = Fraction(0)
    for edge in graph.edges:
        d = edge.duration
        found = Fraction(
            gcd(found.numerator * d.denominator, d.numerator * found.denominator),
            found.denominator * d.denominator,
        )
    return found


def symmetric_rows(P: Matrix) -> list[list[float]]:
    """Return a symmetric matrix as a file has it."""
    return [[float(value) for value in row] for row in (P + P.T) / 2]
