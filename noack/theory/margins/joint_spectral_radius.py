"""The joint spectral radius of a switched system along the paths of a graph, enclosed.

It is the largest growth per unit of time that a path can have in the long run; all paths are stable
exactly if it is below 1. A cycle bounds it from below
(:mod:`noack.theory.margins.switched_system`). From above, three kinds of proofs complement each
other: polytopes (:mod:`noack.theory.margins.invariant_polytopes`), quadratic norms
(:mod:`noack.theory.margins.quadratic_norms`), and products of many steps in such norms
(:func:`bound_by_products`). All bounds include all rounding.

Whether the radius is below a threshold is decided first, since a proof for a growth just below the
threshold is much shorter than one for a growth just above the radius.
"""

import math
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Vector
from noack.theory.margins.exact_matrices import IntervalMatrix, exactly
from noack.theory.margins.invariant_polytopes import InvariantPolytopes, initial_vertices
from noack.theory.margins.quadratic_norms import (
    FEW_ENTRIES,
    MOST_ENTRIES,
    NormSearch,
    norms_above,
    number_of_entries,
    representatives,
    with_history,
)
from noack.theory.margins.switched_system import (
    Cycle,
    Edge,
    Numbers,
    SwitchedSystem,
    find_cycle,
    growth_bounds,
)

ACCURACY = 2e-4
"""Wanted upper/lower − 1: some four digits of the growth."""
_COARSER, _COARSEST = 4.0, 1e15
"""Factor by which the accuracy becomes coarser after a proof that failed, and the largest one."""
_MOST_CYCLE_EDGES = 60
"""Largest length of the cycles that are tried, also in a graph of more nodes."""
MOST_VERTICES = 800
"""Vertices that are added to polytopes to sharpen the bounds; their cost grows with the square."""
_FEW_VERTICES, _MORE_VERTICES = 300, 4000
"""Limits of the two attempts to compare with a threshold."""
_FEW_PRODUCTS, _MORE_PRODUCTS = 30_000, 300_000
"""Limits of both attempts by products."""
MOST_LEAVING = 60
"""Largest number of edges that leave a node for which polytopes are tried."""
_EDGE_CLASSES = 3
"""Classes of edges that a node remembers in the second search for quadratic norms."""
_LEAST_GROWTH = 1e-3
"""Growth of the polytopes if no cycle grows, relative to the largest norm of a matrix."""
_SMALLEST_POWER = 1e-280
"""Growths whose power by a duration is smaller are not distinguished from 0."""
_ROUNDED = 1 + 1e-8
"""A bound of at most γ times this counts as γ, from which it differs by its rounding only."""
_LARGEST_EXPONENT, _NEAR_1 = 600.0, 1e-6
"""Limits of a geometric sum: larger powers count as infinite, and such ratios as 1."""
_SEARCH, _LONG_SEARCH = (20, 100), (40, 300)
"""Length of the cycles that are tried, at least the number of nodes, and the width of the beam."""
_THRESHOLD_SHARE = 0.1
"""A growth below the threshold by this share of its distance from the lower bound is proven."""


class JointSpectralRadius(NamedTuple):
    """Bounds of the joint spectral radius."""

    lower: float
    upper: float
    cycle: tuple[int, ...]
    """Numbers of the edges of the cycle that attains the lower bound, in their order of time."""
    vertices: int
    """Number of vertices of the polytopes that prove the upper bound; 0: it has another proof."""
    needed_effort: float = 0.0
    """If the threshold is between the bounds: an estimate of the effort that would prove the radius
    to be below, if it is the lower bound; infinity if the two hardly differ."""


def joint_spectral_radius(
    edges: Sequence[Edge],
    *,
    accuracy: float = ACCURACY,
    most_vertices: int = MOST_VERTICES,
    threshold: float | None = None,
    effort: float = 1.0,
) -> JointSpectralRadius:
    """Enclose the joint spectral radius.

    Args:
        edges: the system; paths that cannot be continued forever do not count.
        accuracy: wanted upper/lower − 1.
        most_vertices: limit of the work; at the limit the bounds are farther apart. 0: quadratic
            norms take the place of polytopes.
        threshold: a number with which the radius is compared, with more work than its enclosure.
        effort: factor of the limits of the work for this comparison.
    """
    system = SwitchedSystem.of(edges)
    lower, upper, vertices, needed_effort = 0.0, 0.0, 0, 0.0
    path: tuple[int, ...] = ()
    for numbers in system.graph.strongly_connected():
        enclosure = _Enclosure(system.at(numbers), most_vertices)
        if threshold is not None and not enclosure.is_decided(threshold):
            needed_effort = max(needed_effort, enclosure.compare(threshold, effort))
        enclosure.sharpen(accuracy)
        if enclosure.cycle.growth > lower:
            lower = enclosure.cycle.growth
            path = tuple(numbers[list(enclosure.cycle.path)].tolist())
        upper, vertices = max(upper, enclosure.upper), vertices + enclosure.vertices
    if threshold is not None and not lower <= threshold <= upper:
        needed_effort = 0.0
    return JointSpectralRadius(lower, upper, path, vertices, needed_effort)


class _Enclosure:
    """The bounds of a system in which every node can be reached from any other."""

    def __init__(self, system: SwitchedSystem, most_vertices: int) -> None:
        system = system.in_similar_units()
        self._system, self._most_vertices = system, most_vertices
        self.upper, self.vertices = math.inf, 0
        self._is_large = not most_vertices or max(map(len, system.graph.leaving)) > MOST_LEAVING
        self._searches: dict[bool, NormSearch] = {}
        only = system.graph.only_cycle()
        if only is not None:
            bounds = [growth_bounds(part, only) for part in (system, self._balanced)]
            lowers, uppers = zip(*bounds, strict=True)
            self.cycle, self.upper = Cycle(only if max(lowers) else (), max(lowers)), min(uppers)
        elif self._is_large:
            norms = self._search().improve(0.0)
            self._improve(norms.upper)
            numbers = representatives(system.graph, norms.growths)
            cycle = _best_cycle(system.at(numbers), (norms.system or system).at(numbers), _SEARCH)
            self.cycle = cycle._replace(path=tuple(numbers[list(cycle.path)].tolist()))
        else:
            self.cycle = _best_cycle(system, self._balanced, _SEARCH)

    @cached_property
    def _balanced(self) -> SwitchedSystem:
        return self._system.balanced()

    @cached_property
    def _longest_cycle(self) -> Cycle:
        return _best_cycle(self._system, self._balanced, _LONG_SEARCH)

    @cached_property
    def _with_history(self) -> SwitchedSystem:
        """The same system with more nodes, if they are not too many for the search for norms."""
        reaching = int(np.bincount(self._system.graph.targets).max())
        for classes in (_EDGE_CLASSES,) if self._is_large else (reaching, _EDGE_CLASSES):
            system = with_history(self._system, classes)
            if number_of_entries(system) <= FEW_ENTRIES:
                return system
        return self._system

    def _search(self, remembers: bool = False) -> NormSearch:
        """Return the search for norms, which goes on from the best ones so far."""
        if remembers not in self._searches:
            system, entries = self._system, FEW_ENTRIES
            if remembers:
                system, entries = self._with_history, MOST_ENTRIES
            self._searches[remembers] = NormSearch(system, entries)
        return self._searches[remembers]

    def _improve(self, upper: float, vertices: int = 0) -> None:
        self.upper, self.vertices = min((self.upper, self.vertices), (upper, vertices))

    def is_decided(self, threshold: float) -> bool:
        """Return whether the radius is known to be below or above a threshold."""
        return not self.cycle.growth <= threshold <= self.upper

    def compare(self, threshold: float, effort: float) -> float:
        """Try to decide whether the radius is below a threshold; return the effort if it failed."""
        needed_effort = math.inf
        attempts: tuple[Callable[[float], float], ...] = (
            lambda growth: self._prove_by_polytopes(growth, int(_FEW_VERTICES * effort)),
            self._search_longer,
            lambda growth: self._prove_by_norms(growth, int(_FEW_PRODUCTS * effort)),
            lambda growth: self._prove_by_polytopes(growth, int(_MORE_VERTICES * effort)),
            lambda growth: self._prove_by_norms(growth, int(_MORE_PRODUCTS * effort), True),
        )
        for attempt in attempts:
            needed_effort = attempt(threshold - _THRESHOLD_SHARE * (threshold - self.cycle.growth))
            if self.is_decided(threshold):
                return 0.0
        return needed_effort * effort

    def sharpen(self, accuracy: float) -> None:
        """Bring the bounds together as far as the limits of the work allow."""
        is_first = True
        while self.cycle.growth * (1 + accuracy) < self.upper and accuracy < _COARSEST:
            longest = int(self._system.graph.durations.max())
            largest = float(np.abs(self._balanced.matrices.middle).max())
            least = max(_LEAST_GROWTH * largest, _SMALLEST_POWER ** (1 / longest))
            growth = max(self.cycle.growth, least) * (1 + accuracy)
            self._prove_by_polytopes(growth, self._most_vertices)
            if self.upper <= growth * _ROUNDED:
                break
            if is_first:  # if a longer cycle grows faster, no proof can be completed
                is_first, before = False, self.cycle.growth
                self._search_longer(growth)
                if self.cycle.growth > before * (1 + accuracy / 2):
                    continue
                self._prove_by_norms(growth, _FEW_PRODUCTS, remembers=self._is_large)
            if self._is_large:
                break
            accuracy *= _COARSER

    def _search_longer(self, growth: float) -> float:
        """Search for longer cycles; return the effort that a proof would need, which is not known."""
        if not self._is_large:
            self.cycle = max(self.cycle, self._longest_cycle, key=lambda cycle: cycle.growth)
        return math.inf

    def _prove_by_polytopes(self, growth: float, most_vertices: int) -> float:
        """Try to prove a growth; return the effort that this would need, which is not known."""
        if not self._is_large:
            start = initial_vertices(self._balanced, self.cycle, growth)
            polytopes = InvariantPolytopes(self._balanced, growth, start)
            if polytopes.grow(most_vertices) or most_vertices == self._most_vertices:
                # Incomplete polytopes prove a larger growth.
                self._improve(polytopes.bound(), polytopes.count)
        return math.inf

    def _prove_by_norms(self, growth: float, most_products: int, remembers: bool = False) -> float:
        """Try to prove a growth; return the effort that this is estimated to need, 1: the limit."""
        norms = self._search(remembers).improve(growth)
        self._improve(norms.upper)
        if self.upper <= growth * _ROUNDED:
            return math.inf  # if the threshold is not above the bound, by rounding only
        if norms.system is None:
            return math.inf
        try:
            bound = bound_by_products(norms.system, growth, most_products, slowest=self.cycle.growth)
        except FloatingPointError:  # an overflow, where the caller has asked for it
            return math.inf
        self._improve(bound.upper)
        return bound.needed_products / most_products


def _best_cycle(system: SwitchedSystem, balanced: SwitchedSystem, search: tuple[int, int]) -> Cycle:
    """Search in balanced coordinates; return the better bound of the cycle in both coordinates."""
    most_edges, beam = search
    cycle = find_cycle(balanced, min(max(most_edges, system.graph.nodes), _MOST_CYCLE_EDGES), beam)
    if not cycle.path:
        return cycle
    # The original matrices have smaller radii.
    return cycle._replace(growth=max(cycle.growth, growth_bounds(system, cycle.path)[0]))


class ProductBound(NamedTuple):
    """The bound that a limited number of products proves."""

    upper: float
    """Upper bound of the joint spectral radius."""
    products: int
    """Number of products that were examined."""
    needed_products: float
    """Number of products that would prove γ; an estimate if the work was limited."""


class _Paths(NamedTuple):
    """Products of k paths."""

    ends: Numbers
    """The nodes that they lead to, (k,)."""
    matrices: IntervalMatrix
    """(k, n, n)."""
    durations: Numbers
    """(k,)."""
    growths: Vector
    """Upper bounds of ‖Π‖^(1/duration), (k,)."""

    def at(self, numbers: NDArray[np.bool_]) -> "_Paths":
        """Return some of the paths."""
        matrices = self.matrices.at(numbers)
        return _Paths(self.ends[numbers], matrices, self.durations[numbers], self.growths[numbers])

    def then(self, system: SwitchedSystem, edge: int) -> "_Paths":
        """Return the paths, of which all lead to the source of an edge, continued by it."""
        graph = system.graph
        matrices = system.matrices.at(np.array([edge])) @ self.matrices
        durations = self.durations + graph.durations[edge]
        growths = norms_above(matrices) ** (1 / durations) * (1 + 1e-15)
        return _Paths(np.full_like(self.ends, graph.targets[edge]), matrices, durations, growths)


def bound_by_products(
    system: SwitchedSystem, growth: float, most_products: int, *, slowest: float = 0.0
) -> ProductBound:
    """Bound the growth of all paths by products of many steps (Gripenberg, 1996).

    Every path from a node is continued until the norm of its product is at most γ^duration. If that
    ends, every infinite path is a sequence of such products, so no path grows faster than γ. The
    better the coordinates, the earlier a path ends. If the work is limited, the products of the
    last step count as they are: the bound is then above γ, but valid.

    Args:
        system: the system; norms are Euclidean in its coordinates.
        growth: γ, the wanted bound.
        most_products: limit of the work.
        slowest: a lower bound of the joint spectral radius, for the estimate.
    """
    graph, n = system.graph, system.dimension
    upper, products, before, steps = 0.0, 0, 0, 0
    identity, starts = np.tile(np.eye(n), (graph.nodes, 1, 1)), np.arange(graph.nodes)
    paths = _Paths(starts, exactly(identity), np.zeros_like(starts), np.zeros(graph.nodes))
    while len(paths.ends):
        longer: list[_Paths] = []
        for edge, source in enumerate(graph.sources):
            following = paths.at(paths.ends == source).then(system, edge)
            products += len(following.ends)
            ended = following.growths <= growth
            upper = max(upper, float(following.growths[ended].max(initial=0.0)))
            longer.append(following.at(~ended))
        paths = _joined(longer)
        steps += 1
        if len(paths.ends) and products > most_products:
            upper = max(upper, float(paths.growths.max()))
            further = _further_steps(paths, growth, slowest) * steps
            ratio = len(paths.ends) / (before or 1)
            needed = products + len(paths.ends) * _sum_of_powers(ratio, further)
            return ProductBound(upper, products, needed)
        before = len(paths.ends)
    return ProductBound(upper, products, products)


def _joined(parts: Sequence[_Paths]) -> _Paths:
    ends, matrices, durations, growths = zip(*parts, strict=True)
    stack = IntervalMatrix(*map(np.concatenate, zip(*matrices, strict=True)))
    return _Paths(np.concatenate(ends), stack, np.concatenate(durations), np.concatenate(growths))


def _further_steps(paths: _Paths, growth: float, slowest: float) -> float:
    """Estimate how many steps follow until all paths have ended, relative to those until now.

    ‖Π‖ is assumed to stay at its present multiple of ρ^duration, with the lower bound ρ.
    """
    if not 0 < slowest < growth:
        return math.inf
    excess = paths.durations * np.log(paths.growths / slowest)
    missing = float((excess / math.log(growth / slowest) - paths.durations).max())
    return max(missing, 0.0) / float(paths.durations.mean())


def _sum_of_powers(ratio: float, steps: float) -> float:
    """Return about ratio + ratio² + …, as many terms as steps."""
    if not steps * math.log(max(ratio, 1.0)) < _LARGEST_EXPONENT:
        return math.inf
    steps = max(steps, 1.0)
    if abs(ratio - 1) < _NEAR_1:
        return steps
    return float(ratio * (ratio**steps - 1) / (ratio - 1))
