"""The joint spectral radius of a switched system along the paths of a graph, enclosed.

It is the largest growth per unit of time that a path can have in the long run; all paths are stable
exactly if it is below 1. A cycle bounds it from below
(:mod:`noack.theory.destabilising_cycle`), polytopes (:mod:`noack.theory.invariant_polytopes`) or
quadratic norms (:mod:`noack.theory.quadratic_norms`) from above. All bounds include all rounding.
"""

import math
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Vector
from noack.theory.destabilising_cycle import Cycle, find_cycle, growth_bounds, only_cycle
from noack.theory.invariant_polytopes import InvariantPolytopes, initial_vertices
from noack.theory.quadratic_norms import quadratic_norms, remembering
from noack.theory.switched_system import Edge, SwitchedSystem, strongly_connected

ACCURACY = 2e-4
_COARSER, _COARSEST = 4.0, 1e15
_MOST_CYCLE_EDGES = 60
"""Largest length of the cycles that are tried, also in a graph of more nodes."""
MOST_VERTICES = 800
MOST_LEAVING = 60
"""Largest number of edges that leave a node for which polytopes are tried."""
_FASTEST, _STEADY = 8, 17
_REMEMBERED = 3
"""Classes of edges that a node remembers in the second search for quadratic norms."""
_SMALLEST = 1e-3
"""Growth of the polytopes if no cycle grows, relative to the largest norm of a matrix."""


class _Search(NamedTuple):
    edges: int
    """Length of the cycles that are tried; at least the number of nodes."""
    beam: int


_SEARCH, _LONG_SEARCH = _Search(20, 100), _Search(40, 300)


class JointSpectralRadius(NamedTuple):
    """Bounds of the joint spectral radius."""

    lower: float
    upper: float
    cycle: tuple[int, ...]
    """Numbers of the edges of the cycle that attains the lower bound, in their order of time."""
    vertices: int
    """Number of vertices of the polytopes that prove the upper bound; 0: it has another proof."""


def joint_spectral_radius(
    edges: Sequence[Edge], *, accuracy: float = ACCURACY, most_vertices: int = MOST_VERTICES
) -> JointSpectralRadius:
    """Enclose the joint spectral radius.

    Args:
        edges: the system; paths that cannot be continued forever do not count.
        accuracy: wanted upper/lower − 1.
        most_vertices: limit of the work; at the limit the bounds are farther apart. 0: quadratic
            norms take the place of polytopes.
    """
    numbers = {id(edge): number for number, edge in enumerate(edges)}
    lower, upper, vertices = 0.0, 0.0, 0
    path: tuple[int, ...] = ()
    for part in strongly_connected(edges):
        found = _connected(part, accuracy, most_vertices)
        if found.lower > lower:
            lower = found.lower
            path = tuple(numbers[id(part.edges[i])] for i in found.cycle)
        upper, vertices = max(upper, found.upper), vertices + found.vertices
    return JointSpectralRadius(lower, upper, path, vertices)


def _connected(system: SwitchedSystem, accuracy: float, most_vertices: int) -> JointSpectralRadius:
    only = only_cycle(system)
    leaving = Counter(edge.source for edge in system.edges)
    if only is None and (not most_vertices or max(leaving.values()) > MOST_LEAVING):
        return _by_quadratic_norms(system, accuracy)
    balanced = system.balanced()
    upper, vertices, searched = math.inf, 0, False
    if only is None:
        cycle = _best_cycle(system, balanced, _SEARCH)
    else:
        lowers, uppers = zip(*(growth_bounds(one, only) for one in (system, balanced)), strict=True)
        cycle, upper = Cycle(only if max(lowers) else (), max(lowers)), min(uppers)
    while cycle.growth * (1 + accuracy) < upper and accuracy < _COARSEST:
        growth = max(cycle.growth, _SMALLEST * _largest(balanced)) * (1 + accuracy)
        start = initial_vertices(balanced, cycle, growth)
        polytopes = InvariantPolytopes(balanced, growth, start)
        complete = polytopes.grow(most_vertices)
        upper, vertices = min((upper, vertices), (polytopes.bound(), polytopes.count))
        if complete:
            break
        if not searched:  # if a longer cycle grows faster, the polytopes cannot be completed
            searched, before = True, cycle.growth
            upper, vertices = min((upper, vertices), (quadratic_norms(system).upper, 0))
            cycle = max(cycle, _best_cycle(system, balanced, _LONG_SEARCH), key=_growth)
            if cycle.growth > before * (1 + accuracy / 2):
                continue
        accuracy *= _COARSER
    return JointSpectralRadius(cycle.growth, upper, cycle.path, vertices)


def _by_quadratic_norms(system: SwitchedSystem, accuracy: float) -> JointSpectralRadius:
    """Enclose the joint spectral radius of a system with too many edges for polytopes."""
    norms = quadratic_norms(system)
    numbers = _representatives(system, norms.growths)
    fastest = SwitchedSystem(tuple(system.edges[number] for number in numbers))
    cycle = _best_cycle(fastest, fastest.in_coordinates(norms.forms) or fastest, _SEARCH)
    upper = norms.upper
    if upper > cycle.growth * (1 + accuracy):
        upper = min(upper, quadratic_norms(remembering(system, _REMEMBERED)).upper)
    path = tuple(numbers[number] for number in cycle.path)
    return JointSpectralRadius(cycle.growth, upper, path, 0)


def _representatives(system: SwitchedSystem, growths: Vector) -> list[int]:
    """Return some edges that leave each node: those that grow most, and some of each duration."""
    leaving: dict[int, list[int]] = {}
    for number, edge in enumerate(system.edges):
        leaving.setdefault(edge.source, []).append(number)
    found: set[int] = set()
    for members in leaving.values():
        fastest = sorted(members, key=lambda number: -growths[number])[:_FASTEST]
        steady = sorted(members, key=lambda number: system.edges[number].duration)
        places = np.linspace(0, len(steady) - 1, min(_STEADY, len(steady)))
        found.update(fastest)
        found.update(steady[place] for place in places.round().astype(int).tolist())
    return sorted(found)


def _best_cycle(system: SwitchedSystem, balanced: SwitchedSystem, search: _Search) -> Cycle:
    longest = min(max(search.edges, len(system.dimensions)), _MOST_CYCLE_EDGES)
    cycle = find_cycle(balanced, longest, search.beam)
    if not cycle.path:
        return cycle
    # The original matrices have smaller radii.
    return cycle._replace(growth=max(cycle.growth, growth_bounds(system, cycle.path)[0]))


def _growth(cycle: Cycle) -> float:
    return cycle.growth


def _largest(system: SwitchedSystem) -> float:
    return max(float(np.abs(edge.matrix.middle).max()) for edge in system.edges)
