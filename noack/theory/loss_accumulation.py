"""How much all lost updates together move the state, from how many may be lost in a window.

A lost event k moves the input error by K e^{(H+αI)(s−t_k)} e_s(t_k⁻) until an update arrives, so it
moves C x by at most β̃ c(t − t_k), with

    c(τ) = ∫_d^τ k(τ−s) g(s) ds,   k(τ) = ‖C e^{(A+BK+αI)τ} B U‖,   g(τ) = ‖R e^{(H+αI)τ} W⁻¹‖

Its first d seconds count as those of an update in flight. Events are at least δ apart: n·δ seconds
contain at most n of them. If at most m of n consecutive updates are lost, the sum of c(t − t_k) is
at most, in each n·δ seconds of age, the sum of the m largest of the suprema over δ seconds.

The kernels are enclosed on a common grid of equal cells (:mod:`noack.theory.enclosure`). For τ in a
cell, a cell of k meets the ages of two cells of g. Beyond the grid, c(τ) is at most
sup_{s ≥ τ/2} g(s) ∫k + sup g ∫_{s ≥ τ/2} k, and both kernels fall exponentially there.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from noack.core.linear_systems import Vector
from noack.impairments.loss_guarantee import LossWindow
from noack.theory.error_gains import Output
from noack.theory.kernel_bounds import KernelBounds
from noack.theory.plant_gains import PlantGains

_CELLS = 2048
_MOST_BINS = 1 << 16
_ROUNDING = 1 + 1e-9


@dataclass(frozen=True)
class LossAccumulation:
    """The bounds of one plant for lost updates that count from the age ``delay_s`` on."""

    plant: PlantGains
    delay_s: float

    def total(self, output: str, spacing_s: float, windows: Sequence[LossWindow]) -> float:
        """Return the bound of sup‖C x‖ / β̃ from all lost updates; infinite if it is not found."""
        bins = math.ceil(self._until_s / spacing_s) if spacing_s > 0 else _MOST_BINS
        if bins >= _MOST_BINS:
            return math.inf
        highest = _over_bins(self._effects[output], spacing_s / self._cell_s, bins)
        return min(self._total(output, highest, spacing_s, window) for window in windows)

    def _total(self, output: str, highest: Vector, spacing_s: float, window: LossWindow) -> float:
        most, packets = window
        if most == 0:
            return 0.0
        blocks = -(-len(highest) // packets)
        padded = np.zeros(blocks * packets)
        padded[: len(highest)] = highest
        ranked = np.sort(padded.reshape(blocks, packets), axis=1)[:, ::-1]
        beyond = self._beyond(output, most, packets * spacing_s)
        return float(ranked[:, :most].sum()) * _ROUNDING + beyond

    @cached_property
    def _kernels(self) -> tuple[KernelBounds, Mapping[str, KernelBounds]]:
        """The kernel g and the k of every output, over all times."""
        return self.plant.error.kernels[Output.GAIN], self.plant.forced

    @cached_property
    def _until_s(self) -> float:
        """End of the grid: beyond half of it, all kernels are bounded by exponentials."""
        g, forced = self._kernels
        ends_s = [g.edges_s[-1], *(k.edges_s[-1] for k in forced.values())]
        return 2 * float(max(ends_s))

    @property
    def _cell_s(self) -> float:
        return self._until_s / _CELLS

    @cached_property
    def _effects(self) -> Mapping[str, Vector]:
        """The bound of c over each cell, for every output."""
        g, areas = self.plant.on_grid(self._until_s, _CELLS)
        g = np.where(np.arange(1, _CELLS + 1) * self._cell_s > self.delay_s, g, 0.0)
        ages = np.maximum(g, np.append(0.0, g[:-1]))
        return {output: np.convolve(area, ages)[:_CELLS] for output, area in areas.items()}

    def _beyond(self, output: str, most: int, block_s: float) -> float:
        """Bound the sum over the losses that are older than the grid: a falling function f of age.

        The blocks that begin beyond it contribute at most m f(T) + m/block ∫_T^∞ f.
        """
        g, forced = self._kernels
        k, half_s = forced[output], self._until_s / 2
        total = 0.0
        for kernel, level in (
            (g, g.tail_highest * k.integral()),
            (k, k.tail_area * g.sup()),
        ):
            rate = kernel.tail_rate_per_s
            first = level * math.exp(-rate * (half_s - float(kernel.edges_s[-1])))
            total += most * first * (1 + 2 / (rate * block_s))
        return total


def _over_bins(cells: Vector, per_bin: float, bins: int) -> Vector:
    """Return the largest value of the cells that meet each bin; a bin has ``per_bin`` cells."""
    edges = np.minimum(np.floor(np.arange(bins + 1) * per_bin), len(cells) - 1).astype(np.int64)
    return np.asarray(np.maximum(np.maximum.reduceat(cells, edges[:-1]), cells[edges[1:]]))
