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
from collections import Counter
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Vector
from noack.theory.margins.exact_matrices import IntervalMatrix
from noack.theory.margins.invariant_polytopes import InvariantPolytopes, initial_vertices
from noack.theory.margins.quadratic_norms import (
    FEW_ENTRIES,
    MOST_ENTRIES,
    NormSearch,
    entries_of,
    norms_above,
    remembering,
    representatives,
)
from noack.theory.margins.switched_system import (
    Cycle,
    Edge,
    SwitchedSystem,
    find_cycle,
    growth_bounds,
    only_cycle,
    strongly_connected,
)

ACCURACY = 2e-4
_COARSER, _COARSEST = 4.0, 1e15
_MOST_CYCLE_EDGES = 60
"""Largest length of the cycles that are tried, also in a graph of more nodes."""
MOST_VERTICES = 800
_FEW_VERTICES, _MORE_VERTICES = 300, 4000
"""Limits of the two attempts to compare with a threshold."""
_PRODUCTS, _MORE_PRODUCTS = 30_000, 300_000
MOST_LEAVING = 60
"""Largest number of edges that leave a node for which polytopes are tried."""
_REMEMBERED = 3
"""Classes of edges that a node remembers in the second search for quadratic norms."""
_LEAST_GROWTH = 1e-3
"""Growth of the polytopes if no cycle grows, relative to the largest norm of a matrix."""
_SMALLEST_POWER = 1e-280
"""Growths whose power by a duration is smaller are not distinguished from 0."""
_ROUNDED = 1 + 1e-8
_WITHIN = 0.1
"""A growth below the threshold by this share of its distance from the lower bound is proven."""


class _CycleSearch(NamedTuple):
    edges: int
    """Length of the cycles that are tried; at least the number of nodes."""
    beam: int


_SEARCH, _LONG_SEARCH = _CycleSearch(20, 100), _CycleSearch(40, 300)


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
    numbers = {id(edge): number for number, edge in enumerate(edges)}
    lower, upper, vertices, needed_effort = 0.0, 0.0, 0, 0.0
    path: tuple[int, ...] = ()
    for part in strongly_connected(edges):
        enclosure = _Enclosure(part, most_vertices)
        if threshold is not None and not enclosure.is_decided(threshold):
            needed_effort = max(needed_effort, enclosure.compare(threshold, effort))
        enclosure.sharpen(accuracy)
        if enclosure.cycle.growth > lower:
            lower = enclosure.cycle.growth
            path = tuple(numbers[id(part.edges[i])] for i in enclosure.cycle.path)
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
        leaving = Counter(edge.source for edge in system.edges)
        self._is_large = not most_vertices or max(leaving.values()) > MOST_LEAVING
        self._searches: dict[bool, NormSearch] = {}
        only = only_cycle(system)
        if only is not None:
            bounds = [growth_bounds(part, only) for part in (system, self._balanced)]
            lowers, uppers = zip(*bounds, strict=True)
            self.cycle, self.upper = Cycle(only if max(lowers) else (), max(lowers)), min(uppers)
        elif self._is_large:
            norms = self._search().improve(0.0)
            self._improve(norms.upper)
            numbers = representatives(system, norms.growths)
            fastest = SwitchedSystem(tuple(system.edges[number] for number in numbers))
            turned = fastest.in_coordinates(norms.forms) or fastest
            cycle = _best_cycle(fastest, turned, _SEARCH)
            path = tuple(numbers[number] for number in cycle.path)
            self.cycle = cycle._replace(path=path)
        else:
            self.cycle = _best_cycle(system, self._balanced, _SEARCH)

    @cached_property
    def _balanced(self) -> SwitchedSystem:
        return self._system.balanced()

    @cached_property
    def _longest_cycle(self) -> Cycle:
        return _best_cycle(self._system, self._balanced, _LONG_SEARCH)

    @cached_property
    def _remembering(self) -> SwitchedSystem:
        """The same system with more nodes, if they are not too many for the search for norms."""
        reaching = Counter(edge.target for edge in self._system.edges)
        for classes in (_REMEMBERED,) if self._is_large else (max(reaching.values()), _REMEMBERED):
            system = remembering(self._system, classes)
            if entries_of(system) <= FEW_ENTRIES:
                return system
        return self._system

    def _search(self, remembers: bool = False) -> NormSearch:
        if remembers not in self._searches:
            system, entries = self._system, FEW_ENTRIES
            if remembers:
                system, entries = self._remembering, MOST_ENTRIES
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
            lambda growth: self._prove_by_norms(growth, int(_PRODUCTS * effort)),
            lambda growth: self._prove_by_polytopes(growth, int(_MORE_VERTICES * effort)),
            lambda growth: self._prove_by_norms(growth, int(_MORE_PRODUCTS * effort), True),
        )
        for attempt in attempts:
            needed_effort = attempt(threshold - _WITHIN * (threshold - self.cycle.growth))
            if self.is_decided(threshold):
                return 0.0
        return needed_effort * effort

    def sharpen(self, accuracy: float) -> None:
        """Bring the bounds together as far as the limits of the work allow."""
        is_first = True
        while self.cycle.growth * (1 + accuracy) < self.upper and accuracy < _COARSEST:
            longest = max(edge.duration for edge in self._system.edges)
            least = max(_LEAST_GROWTH * _largest(self._balanced), _SMALLEST_POWER ** (1 / longest))
            growth = max(self.cycle.growth, least) * (1 + accuracy)
            self._prove_by_polytopes(growth, self._most_vertices)
            if self.upper <= growth * _ROUNDED:
                break
            if is_first:  # if a longer cycle grows faster, no proof can be completed
                is_first, before = False, self.cycle.growth
                self._search_longer(growth)
                if self.cycle.growth > before * (1 + accuracy / 2):
                    continue
                self._prove_by_norms(growth, _PRODUCTS, remembers=self._is_large)
            if self._is_large:
                break
            accuracy *= _COARSER

    def _search_longer(self, growth: float) -> float:
        if not self._is_large:
            self.cycle = max(self.cycle, self._longest_cycle, key=lambda cycle: cycle.growth)
        return math.inf

    def _prove_by_polytopes(self, growth: float, most_vertices: int) -> float:
        if not self._is_large:
            start = initial_vertices(self._balanced, self.cycle, growth)
            polytopes = InvariantPolytopes(self._balanced, growth, start)
            if polytopes.grow(most_vertices) or most_vertices == self._most_vertices:
                # Incomplete polytopes prove a larger growth.
                self._improve(polytopes.bound(), polytopes.count)
        return math.inf

    def _prove_by_norms(self, growth: float, entries: int, remembers: bool = False) -> float:
        """Try to prove a growth; return the effort that this is estimated to need, 1: the limit."""
        norms = self._search(remembers).improve(growth)
        self._improve(norms.upper)
        if self.upper <= growth * _ROUNDED:
            return math.inf  # if the threshold is not above the bound, by rounding only
        system = self._remembering if remembers else self._system
        turned = system.in_coordinates(norms.forms)
        if turned is None:
            return math.inf
        try:
            bound = bound_by_products(turned, growth, entries, slowest=self.cycle.growth)
        except FloatingPointError:  # an overflow, where the caller has asked for it
            return math.inf
        self._improve(bound.upper)
        return bound.needed_products / entries


def _best_cycle(system: SwitchedSystem, balanced: SwitchedSystem, search: _CycleSearch) -> Cycle:
    longest = min(max(search.edges, len(system.dimensions)), _MOST_CYCLE_EDGES)
    cycle = find_cycle(balanced, longest, search.beam)
    if not cycle.path:
        return cycle
    # The original matrices have smaller radii.
    return cycle._replace(growth=max(cycle.growth, growth_bounds(system, cycle.path)[0]))


def _largest(system: SwitchedSystem) -> float:
    return max(float(np.abs(edge.matrix.middle).max()) for edge in system.edges)


_LARGEST_EXPONENT, _NEAR_1 = 600.0, 1e-6


class ProductBound(NamedTuple):
    """What a limited number of products proves."""

    upper: float
    """Upper bound of the joint spectral radius."""
    products: int
    """Number of products that were examined."""
    needed_products: float
    """Number of products that would prove γ; an estimate if the work was limited."""


class _Paths(NamedTuple):
    """Products of paths between two nodes, which are to be continued."""

    matrices: IntervalMatrix
    """(k, n_w, n_v)."""
    durations: Vector
    """(k,)."""
    growths: Vector
    """Upper bounds of ‖Π‖^(1/duration), (k,)."""

    def where(self, kept: NDArray[np.bool_]) -> "_Paths":
        """Return some of the paths."""
        matrices = IntervalMatrix(self.matrices.middle[kept], self.matrices.radius[kept])
        return _Paths(matrices, self.durations[kept], self.growths[kept])


_Ends = tuple[int, int]
"""Source and target of paths."""


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
    leaving: dict[int, list[Edge]] = {}
    for edge in system.edges:
        leaving.setdefault(edge.source, []).append(edge)
    upper, products, before, steps = 0.0, 0, 0, 0
    paths: dict[_Ends, _Paths] = {
        (node, node): _Paths(IntervalMatrix(np.eye(n)[None], np.zeros((1, n, n))), np.zeros(1), np.zeros(1))
        for node, n in system.dimensions.items()
    }
    while paths:
        longer: dict[_Ends, list[_Paths]] = {}
        for (source, target), group in paths.items():
            for edge in leaving[target]:
                following = _continued(group, edge)
                products += len(following.durations)
                ended = following.growths <= growth
                upper = max(upper, float(following.growths[ended].max(initial=0.0)))
                if not ended.all():
                    longer.setdefault((source, edge.target), []).append(following.where(~ended))
        paths = {ends: _joined(parts) for ends, parts in longer.items()}
        steps += 1
        count = sum(len(group.durations) for group in paths.values())
        if paths and products > most_products:
            remaining = list(paths.values())
            upper = max(upper, *(float(group.growths.max()) for group in remaining))
            durations = np.concatenate([group.durations for group in remaining])
            growths = np.concatenate([group.growths for group in remaining])
            further = _further_steps(durations, growths, growth, slowest) * steps
            ratio = count / before if before else float(count)
            return ProductBound(upper, products, products + count * _sum_of_powers(ratio, further))
        before = count
    return ProductBound(upper, products, products)


def _continued(paths: _Paths, edge: Edge) -> _Paths:
    matrices, durations = edge.matrix @ paths.matrices, paths.durations + edge.duration
    growths = norms_above(matrices) ** (1 / durations) * (1 + 1e-15)
    return _Paths(matrices, durations, growths)


def _joined(parts: Sequence[_Paths]) -> _Paths:
    matrices, durations, growths = zip(*parts, strict=True)
    middles, radii = zip(*matrices, strict=True)
    return _Paths(
        IntervalMatrix(np.concatenate(middles), np.concatenate(radii)),
        np.concatenate(durations),
        np.concatenate(growths),
    )


def _further_steps(durations: Vector, growths: Vector, growth: float, slowest: float) -> float:
    """Estimate how many steps follow until all paths have ended, relative to those until now.

    ‖Π‖ is assumed to stay at its present multiple of ρ^duration, with the lower bound ρ.
    """
    if not 0 < slowest < growth:
        return math.inf
    excess = durations * np.log(growths / slowest)
    missing = float((excess / math.log(growth / slowest) - durations).max())
    return max(missing, 0.0) / float(durations.mean())


def _sum_of_powers(ratio: float, steps: float) -> float:
    """Return about ratio + ratio² + …, as many terms as steps."""
    if not steps * math.log(max(ratio, 1.0)) < _LARGEST_EXPONENT:
        return math.inf
    steps = max(steps, 1.0)
    if abs(ratio - 1) < _NEAR_1:
        return steps
    return float(ratio * (ratio**steps - 1) / (ratio - 1))
