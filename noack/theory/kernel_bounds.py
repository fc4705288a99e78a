"""Upper bounds of the norm of a response over time: over cells of a grid, and beyond it.

:mod:`noack.theory.enclosure` computes them.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray


class NotDecayingError(ArithmeticError):
    """The generator is not Hurwitz: bounds over all times would be infinite."""


@dataclass(frozen=True)
class KernelBounds:
    """Upper bounds of k(τ) = ‖C e^{Gτ} D‖ (spectral norm) on a grid of cells, and beyond it."""

    edges_s: NDArray[np.float64]
    """(cells + 1,) nodes of the grid, from 0."""
    highest: NDArray[np.float64]
    """(cells,) bound of k over each cell."""
    area: NDArray[np.float64]
    """(cells,) bound of ∫k over each cell."""
    tail_highest: float
    """Bound of k beyond the grid; infinite if it was not requested."""
    tail_area: float
    """Bound of ∫k beyond the grid."""
    tail_rate_per_s: float
    """Decay rate of the bound of k beyond the grid."""

    def sup(self, after_s: float = 0.0) -> float:
        """Sup of k(τ) over τ ≥ ``after_s``."""
        return float(self.sups(np.array([after_s]))[0])

    def sups(self, after_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Sup of k(τ) over τ ≥ a for each a, (j,)."""
        first = np.searchsorted(self.edges_s, after_s, side="right") - 1
        beyond_s = np.maximum(after_s - self.edges_s[-1], 0.0)
        return np.asarray(self._from_cell[first] * np.exp(-self.tail_rate_per_s * beyond_s))

    @cached_property
    def _from_cell(self) -> NDArray[np.float64]:
        """Sup of k from the begin of each cell on."""
        return np.maximum.accumulate(np.append(self.highest, self.tail_highest)[::-1])[::-1]

    def integral(self) -> float:
        """∫k over all times."""
        return float(self.area.sum()) + self.tail_area

    def sup_on_grid(self) -> float:
        """Sup of k over the grid only."""
        return float(self.highest.max(initial=0.0))

    def integral_on_grid(self) -> float:
        """∫k over the grid only."""
        return float(self.area.sum())


def constant_kernel(value: float) -> KernelBounds:
    """Return the kernel of a constant response."""
    edges_s = np.array([0.0, 1.0])
    return KernelBounds(edges_s, np.full(1, value), np.full(1, value), value, math.inf, 0.0)
