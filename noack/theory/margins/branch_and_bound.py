"""Upper bounds of the joint spectral radius by products of many steps (Gripenberg, 1996).

Every path from a node is continued until the norm of its product is at most γ^duration. If that
ends, every infinite path is a sequence of such products, so no path grows faster than γ. The norm
is Euclidean in the coordinates of each node; the better these are, the earlier a path ends. If the
work is limited, the products of the last step count as they are: the bound is then above γ, but
valid.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Vector
from noack.theory.margins.exact_matrices import IntervalMatrix
from noack.theory.margins.quadratic_norms import norms_above
from noack.theory.margins.switched_system import Edge, SwitchedSystem

_LARGEST_EXPONENT, _NEAR_1 = 600.0, 1e-6


class ProductBound(NamedTuple):
    """What a limited number of products proves."""

    upper: float
    """Upper bound of the joint spectral radius."""
    products: int
    """Number of products that were examined."""
    needed: float
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
    """Bound the growth of all paths.

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
        for (source, target), ones in paths.items():
            for edge in leaving[target]:
                following = _continued(ones, edge)
                products += len(following.durations)
                ended = following.growths <= growth
                upper = max(upper, float(following.growths[ended].max(initial=0.0)))
                if not ended.all():
                    longer.setdefault((source, edge.target), []).append(following.where(~ended))
        paths = {ends: _joined(parts) for ends, parts in longer.items()}
        steps += 1
        count = sum(len(ones.durations) for ones in paths.values())
        if paths and products > most_products:
            remaining = list(paths.values())
            upper = max(upper, *(float(ones.growths.max()) for ones in remaining))
            durations = np.concatenate([ones.durations for ones in remaining])
            growths = np.concatenate([ones.growths for ones in remaining])
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
