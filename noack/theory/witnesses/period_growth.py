"""The search for proofs of the growth of a loop document without motions (R8 of the kernel).

Nothing here has to be right: the kernel verifies what is found.

1. *At least*: of all paths of each length those with the largest products are continued, and the cycle with
   the largest growth is kept.
2. *At most*: Clarabel looks for a quadratic form of each location with the smallest violation of
   g^{2T/U} P − JᵀP⁺J ⪰ 0. The kernel adds edges to a path until its product obeys the inequality, so a
   violation need not be 0.
"""

from collections.abc import Mapping, Sequence
from fractions import Fraction
from functools import cached_property, reduce
from math import gcd
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_lyapunov

from noack.core.linear_systems import Matrix, Stack, Vector
from noack.proof.period_graph import PeriodEdge, PeriodGraph, fraction_text
from noack.proof.semidefinite import Accuracy, MatrixInequality, minimise
from noack.theory.time_triggered.graph import Graph

Entry = dict[str, Any]
Path = tuple[int, ...]
"""Numbers of edges that follow each other."""
Numbers = NDArray[np.int64]
_SOLVED = Accuracy(gap=1e-5, feasibility=1e-7, improves_steps=False)
_LEVEL_WEIGHT = 1e-6
"""Weight of the largest entry of the forms in their search, relative to what they violate."""
_BEAM, _LEAST_BEAM, _MOST_MULTIPLICATIONS = 100, 20, 3e6
"""Paths that are continued; fewer if the products of a length take more multiplications."""
_CYCLE_EDGES, _MOST_BURSTS, _MOST_PROVEN_BURSTS = 14, 1500, 300
"""Edges of the longest cycle, and paths between two locations that replace single edges."""
_LONGEST_PATH, _MOST_PRODUCTS, _KERNEL_PRODUCTS = 22, 2000, 10_000
"""Paths one after the other, and their products, of which the kernel computes some thousand in a second."""
_EQUAL = 1e-11
"""Entries of products that differ by less are equal."""
_REAL = 1e-9
"""An eigenvalue with a smaller imaginary part, relatively, is real."""
_DIGITS = 12
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
        self._kept = [[graph.states.index(i) for i in inside] for inside in graph.inside]
        maps = np.zeros((len(graph.edges), n, n))
        for M, edge in zip(maps, graph.edges, strict=True):
            inside = np.ix_(self._kept[edge.target], self._kept[edge.source])
            M[inside] = (edge.map[np.ix_(graph.states, graph.states)] * scale)[inside]
        self._maps: Stack = maps
        periods = [int(edge.duration / self.period) for edge in graph.edges]
        self._periods = np.array(periods, np.int64)

    @cached_property
    def cycle(self) -> Cycle | None:
        """The cycle with the largest growth that was found; None: no state grows or decays in one."""
        paths = self._bursts(merges=True) or self._single_edges
        edges, maps = self.graph.edges, self._products(paths)
        nodes = {place: k for k, place in enumerate(dict.fromkeys(edges[path[0]].source for path in paths))}
        graph = Graph(
            np.array([nodes[edges[path[0]].source] for path in paths]),
            np.array([nodes[edges[path[-1]].target] for path in paths]),
            self._durations(paths),
        )
        work = max(map(len, graph.leaving)) * maps.shape[1] ** 3
        beam = max(min(_BEAM, int(_MOST_MULTIPLICATIONS / work)), _LEAST_BEAM)
        T = graph.balancing(maps)
        balanced = T[graph.targets] @ maps @ np.linalg.inv(T)[graph.sources]
        growth, cycle = graph.fastest_cycle(balanced, max(_CYCLE_EDGES, 2 * graph.nodes), beam)
        if not cycle:
            return None
        return Cycle(float(np.exp(growth)), tuple(edges[k] for number in cycle for k in paths[number]))

    @property
    def _single_edges(self) -> list[Path]:
        return [(number,) for number in range(len(self._maps))]

    def _products(self, paths: Sequence[Path]) -> Stack:
        one = np.eye(self._maps.shape[1])
        found = [reduce(lambda M, k: self._maps[k] @ M, path, one) for path in paths]
        return np.array(found).reshape(len(paths), *one.shape)

    def _durations(self, paths: Sequence[Path]) -> Numbers:
        return np.array([self._periods[list(path)].sum() for path in paths], np.int64)

    def _bursts(self, *, merges: bool) -> list[Path]:
        """Return the paths between locations that are reached from several ones.

        Args:
            merges: whether one of the paths stands for all that have the same product.

        Returns:
            None of them if there are too many.
        """
        edges, n = self.graph.edges, self._maps.shape[1]
        sources: dict[int, set[int]] = {}
        leaving: dict[int, list[int]] = {}
        for number, edge in enumerate(edges):
            sources.setdefault(edge.target, set()).add(edge.source)
            leaving.setdefault(edge.source, []).append(number)
        kept = {place for place in leaving if len(sources.get(place, ())) > 1}
        found = list[Path]()
        pending: list[tuple[Path, int, Matrix]] = [((), place, np.eye(n)) for place in sorted(kept)]
        while pending:
            paths: dict[object, tuple[Path, int, Matrix]] = {}
            for path, end, product in pending:
                for k in leaving.get(end, ()):
                    longer, further = (*path, k), self._maps[k] @ product
                    # Outcomes that make no difference are one: inputs that do not change may be late.
                    merged = edges[longer[0]].source, edges[k].target, (further / _EQUAL).round().tobytes()
                    paths.setdefault(merged if merges else longer, (longer, edges[k].target, further))
            found += [path for path, end, _ in paths.values() if end in kept]
            pending = [entry for entry in paths.values() if entry[1] not in kept]
            is_large = len(found) + len(pending) > (_MOST_BURSTS if merges else _MOST_PROVEN_BURSTS)
            if is_large or any(len(path) > len(leaving) for path, *_ in pending):
                return []
        return found

    def at_least(self, cycle: Cycle, below: float) -> Entry | None:
        """Return the proof that a cycle grows nearly by its growth, by so much less, relatively."""
        factor = np.floor(cycle.growth * (1 - below) * 10**_DIGITS) / 10**_DIGITS
        if not factor > 0:
            return None
        numbers = [self.graph.edges.index(edge) for edge in cycle.edges]
        product = reduce(lambda M, k: self._maps[k] @ M, numbers, np.eye(self._maps.shape[1]))
        kept = self._kept[cycle.edges[0].source]
        product, units = product[np.ix_(kept, kept)], self._units[kept]
        least = float(factor) ** int(self._periods[numbers].sum())
        entry: Entry = {"factor": float(factor), "period": fraction_text(self.period)}
        entry["cycle"] = [edge.name for edge in cycle.edges]
        values, vectors = np.linalg.eig(product)
        largest = int(np.argmax(np.abs(values)))
        if abs(values[largest].imag) <= _REAL * abs(values[largest]):
            return entry | {"sign": "positive" if values[largest].real > 0 else "negative"}
        A = product / least
        try:
            P = -solve_discrete_lyapunov(A.T, np.eye(len(A)))
        except np.linalg.LinAlgError:
            return None
        v = max((vectors[:, largest].real, vectors[:, largest].imag), key=lambda v: float(v @ P @ v))
        size = float(np.abs(P).max())
        form = P / size / np.outer(units, units)
        return entry | {"form": symmetric_rows(form), "vector": [[float(x)] for x in v * units]}

    def at_most(self, growth: float, effort: float = 1.0) -> Entry | None:
        """Return the proof that nothing grows faster than by a factor per period, if forms are found.

        Args:
            growth: the factor.
            effort: factor of the number of products that the kernel may have to compute.
        """
        factor = np.ceil(growth * 10**_DIGITS) / 10**_DIGITS
        paths = self._bursts(merges=False) or self._single_edges
        if self.is_only_cycle:
            forms = self._sums(factor ** self._periods.astype(float))
        else:
            forms = self._forms(paths, factor)
        if forms is None or not self._paths_end(paths, forms, float(factor), effort * _MOST_PRODUCTS):
            return None
        rows = {}
        for place, P in forms.items():
            units = self._units[self._kept[place]]
            rows[self.graph.locations[place]] = symmetric_rows(P / np.outer(units, units))
        entry = {"factor": float(factor), "period": fraction_text(self.period), "forms": rows}
        if len(self.graph.locations) < len(self.graph.document["locations"]):
            entry["only"] = list(self.graph.locations)
        return entry

    @property
    def is_only_cycle(self) -> bool:
        """Whether each location is left by one edge only, so that there is no choice."""
        return len({edge.source for edge in self.graph.edges}) == len(self.graph.edges)

    def _sums(self, growths: Vector) -> dict[int, Matrix] | None:
        """Return P = Σ (J^k)ᵀ J^k over all edges that follow: forms for each growth above the cycle's own."""
        leaving = {edge.source: number for number, edge in enumerate(self.graph.edges)}
        n, steps = self._maps.shape[1], self._maps / growths[:, None, None]
        path = [next(iter(leaving))]
        while (following := self.graph.edges[leaving[path[-1]]].target) not in path:
            path.append(following)
        cycle = path[path.index(following) :]
        around = reduce(lambda M, place: steps[leaving[place]] @ M, cycle, np.eye(n))
        sums, product = np.zeros((n, n)), np.eye(n)
        for place in cycle:
            sums += product.T @ product
            product = steps[leaving[place]] @ product
        forms = {cycle[0]: np.asarray(solve_discrete_lyapunov(around.T, sums), np.float64)}
        pending = [place for place in leaving if place != cycle[0]]
        while pending:
            place = next(p for p in pending if self.graph.edges[leaving[p]].target in forms)
            J = steps[leaving[place]]
            forms[place] = np.eye(n) + J.T @ forms[self.graph.edges[leaving[place]].target] @ J
            pending.remove(place)
        found = {place: P[np.ix_(self._kept[place], self._kept[place])] for place, P in forms.items()}
        return found if all(np.isfinite(P).all() for P in found.values()) else None

    def _ends(self, paths: Sequence[Path]) -> tuple[list[int], list[int]]:
        """Return where paths begin and end."""
        edges = self.graph.edges
        return [edges[path[0]].source for path in paths], [edges[path[-1]].target for path in paths]

    def _forms(self, paths: Sequence[Path], factor: float) -> dict[int, Matrix] | None:
        """Return forms with P − JᵀP⁺J/g² ⪰ −s for the smallest s; None: the solver fails."""
        problem, (sources, targets) = [], self._ends(paths)
        places = sorted({*sources, *targets})
        for place in places:
            one = np.eye(len(self._kept[place]))
            problem.append(MatrixInequality(((str(place), one / 2, one),), (), -one))
            problem.append(MatrixInequality(((str(place), -one / 2, one),), (("level", one),), 0 * one))
        growths = factor ** self._durations(paths).astype(float)
        for source, target, M, growth in zip(sources, targets, self._products(paths), growths, strict=True):
            J = M[np.ix_(self._kept[target], self._kept[source])] / growth
            one = np.eye(J.shape[1])
            parts = ((str(source), one / 2, one), (str(target), -J / 2, J))
            problem.append(MatrixInequality(parts, (("violation", one),), 0 * one))
        objective = {"violation": 1.0, "level": _LEVEL_WEIGHT}
        answer = minimise(objective, problem, margin=0.0, accuracy=_SOLVED)
        forms = {place: answer.matrices[str(place)] for place in places}
        return forms if all(np.isfinite(P).all() for P in forms.values()) else None

    def _paths_end(
        self, paths: Sequence[Path], forms: Mapping[int, Matrix], factor: float, most: float
    ) -> bool:
        """Return whether every sequence of paths has a beginning that grows by less than the factor."""
        n, count = self._maps.shape[1], len(self._kept)
        T, inverse = np.zeros((count, n, n)), np.zeros((count, n, n))
        for place, P in forms.items():
            kept = np.ix_(self._kept[place], self._kept[place])
            try:
                root = np.linalg.cholesky(P).T
            except np.linalg.LinAlgError:
                return False
            T[place][kept], inverse[place][kept] = root, np.linalg.inv(root)
        sources, targets = map(np.array, self._ends(paths))
        growths = factor ** self._durations(paths).astype(float)
        steps: Stack = T[targets] @ self._products(paths) @ inverse[sources] / growths[:, None, None]
        leaving = [np.flatnonzero(sources == place) for place in range(count)]
        ends, products, total = targets, steps, 0
        for _ in range(_LONGEST_PATH):
            grows = ~(np.linalg.norm(products, 2, axis=(1, 2)) < 1 - 1e-12)
            if not grows.any():
                return True
            ends, products = ends[grows], products[grows]
            step = np.concatenate([leaving[end] for end in ends])
            total += len(step)
            if total > min(most, _KERNEL_PRODUCTS):
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
