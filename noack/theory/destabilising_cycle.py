"""Lower bounds of the joint spectral radius: cycles, and the spectral radius of their products.

The search keeps, of all paths of k edges, those with the largest products relative to the bound so
far; it is a heuristic. The bound of a cycle found is rigorous: for every k, |trace Π^k| ≤ n ρ(Π)^k,
and by repeated squaring in enclosures k becomes so large that n^(1/k) is 1 to working precision.
Beforehand, Π is taken to the coordinates of its eigenvectors: there squaring loses no digits.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix
from noack.theory.interval_matrix import IntervalMatrix, exactly, inverse
from noack.theory.switched_system import SwitchedSystem

_TINY = float(np.finfo(np.float64).tiny)
_SQUARINGS = 44
_SUBTRACTED = 1 - 1e-15


class Cycle(NamedTuple):
    """A closed path and a rigorous lower bound of its growth."""

    path: tuple[int, ...]
    """Numbers of its edges."""
    growth: float
    """At most ρ(Π)^(1/duration)."""


NO_CYCLE = Cycle((), 0.0)


def spectral_radius_below(product: IntervalMatrix) -> float:
    """Return a lower bound of the spectral radius of all matrices of an enclosure, (n, n).

    It is the k-th root of |trace Π^k|/n, for the best k = 2^j.
    """
    bounds = [_trace_bound(product)]
    basis = _eigenvectors(product.middle)
    undone = inverse(basis)
    if undone is not None:
        bounds.append(_trace_bound(undone @ product @ exactly(basis)))
    return max(bounds)


def _trace_bound(power: IntervalMatrix) -> float:
    best, exponent = 0.0, 0.0
    n = len(power.middle)
    for j in range(_SQUARINGS):
        trace = abs(math.fsum(np.diag(power.middle)))
        trace = trace * _SUBTRACTED - math.fsum(np.diag(power.radius)) / _SUBTRACTED
        if trace > 0:
            # Π^(2^j) is the enclosure times 2^exponent; the logarithms are accurate to 1e-14.
            logarithm = (math.log2(trace / n) + exponent) / 2**j
            slack = 1e-15 * (4 + abs(exponent / 2**j) + abs(logarithm))
            best = max(best, 2 ** (logarithm - slack) * (1 - 4e-16))
        largest = float(np.abs(power.middle).max())
        if not float(power.radius.max()) < largest < math.inf:
            break
        shift = -math.frexp(largest)[1]
        power = power.scaled(shift)
        exponent = 2 * (exponent - shift)
        power = power @ power
    return best


def _eigenvectors(matrix: Matrix) -> Matrix:
    """Return a real basis in which a matrix is nearly block-diagonal, as columns."""
    values, vectors = np.linalg.eig(matrix)
    basis = np.where(values.imag >= 0, vectors.real, vectors.imag)
    return np.ascontiguousarray(basis)


class _Path(NamedTuple):
    edges: tuple[int, ...]
    source: int
    target: int
    duration: int
    product: Matrix
    norm: float


def find_cycle(system: SwitchedSystem, most_edges: int, beam: int) -> Cycle:
    """Search for the cycle with the largest growth among those of up to ``most_edges`` edges.

    Args:
        system: the system, best in balanced coordinates.
        most_edges: largest length.
        beam: number of paths that are kept at each length.
    """
    best: tuple[int, ...] = ()
    growth = 0.0
    leaving: dict[int, list[_Path]] = {}
    for number, edge in enumerate(system.edges):
        M = edge.matrix.middle
        step = _Path((number,), edge.source, edge.target, edge.duration, M, _size(M))
        leaving.setdefault(edge.source, []).append(step)
    paths = [step for steps in leaving.values() for step in steps]
    for _ in range(most_edges):
        closed = [one for one in paths if one.source == one.target]
        for one in closed:
            # A product cannot grow faster than its norm.
            if one.norm <= (growth * (1 + 1e-12)) ** one.duration:
                continue
            found = float(np.abs(np.linalg.eigvals(one.product)).max()) ** (1 / one.duration)
            if found > growth * (1 + 1e-12):
                best, growth = one.edges, found
        scale = growth or 1.0
        paths.sort(key=lambda one: one.norm / max(scale**one.duration, _TINY), reverse=True)
        paths = [_joined(one, step) for one in paths[:beam] for step in leaving[one.target]]
    if not best:
        return NO_CYCLE
    return Cycle(best, rigorous_growth(system, best))


def rigorous_growth(system: SwitchedSystem, path: Sequence[int]) -> float:
    """Return a lower bound of the growth of a cycle per unit of time."""
    radius = spectral_radius_below(system.product(path))
    return float(radius ** (1 / system.duration(path)) * (1 - 1e-15))


def _joined(one: _Path, step: _Path) -> _Path:
    product = step.product @ one.product
    duration = one.duration + step.duration
    return _Path(one.edges + step.edges, one.source, step.target, duration, product, _size(product))


def _size(matrix: Matrix) -> float:
    return math.sqrt(float(np.vdot(matrix, matrix)))
