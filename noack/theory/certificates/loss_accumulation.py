"""The effect of all lost updates on x, if few of them may be lost in a window.

Γ_C of :mod:`noack.theory.certificates.inequalities` is smaller then. A lost event k moves the input
error by K e^{(H+αI)(s−t_k)} e_s(t_k⁻) until an update arrives, so it moves C x by at most
β̃ c(t − t_k), with

    c(τ) = ∫_d^τ k(τ−s) g(s) ds,   k(τ) = ‖C e^{(A+BK+αI)τ} B U‖,   g(τ) = ‖R e^{(H+αI)τ} W⁻¹‖

Its first d seconds count as those of an update in flight. Events are at least δ apart: n·δ seconds
contain at most n of them. If at most m of n consecutive updates are lost, the sum of c(t − t_k) is
at most, in each n·δ seconds of age, the sum of the m largest of the suprema over δ seconds. The
kernels are enclosed on a common grid of equal cells. For τ in a cell, a cell of k meets the ages of
two cells of g. Beyond the grid, c(τ) is at most sup_{s ≥ τ/2} g(s) ∫k + sup g ∫_{s ≥ τ/2} k, and
both kernels fall exponentially there.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix, Vector
from noack.impairments.loss_guarantee import LossWindow
from noack.theory.bounds.enclosure import KernelBounds
from noack.theory.bounds.gains import Output, PlantGains

_CELLS = 2048
_MOST_BINS = 1 << 16
_ROUNDING = 1 + 1e-9
_EPSILON = float(np.finfo(float).eps)
_TRANSFORMED = 3 * math.log2(2 * _CELLS) * _EPSILON
"""Times the norms of both factors, this exceeds the rounding of a convolution by transforms."""


@dataclass(frozen=True)
class LossAccumulation:
    """The bounds of one plant, or of several, for lost updates that count from ``delay_s`` on."""

    plant: PlantGains
    delay_s: float

    def total(self, output: str, spacing_s: float, windows: Sequence[LossWindow], loop: int = 0) -> float:
        """Return the bound of sup‖C x‖ / β̃ from all lost updates; infinite if it is not found."""
        until_s = self._until_s[self._place(self._until_s, loop)]
        bins = math.ceil(until_s / spacing_s) if spacing_s > 0 else _MOST_BINS
        if bins >= _MOST_BINS:
            return math.inf
        effects = self._effects[output][self._place(self._effects[output], loop)]
        highest = _over_bins(effects, spacing_s / (until_s / _CELLS), bins)
        return min(self._total(output, highest, spacing_s, window, loop) for window in windows)

    def _total(self, output: str, highest: Vector, spacing_s: float, window: LossWindow, loop: int) -> float:
        losses, packets = window
        if losses == 0:
            return 0.0
        blocks = -(-len(highest) // packets)
        padded = np.zeros(blocks * packets)
        padded[: len(highest)] = highest
        ranked = np.sort(padded.reshape(blocks, packets), axis=1)[:, ::-1]
        falling = self._beyond[output][self._place(self._beyond[output], loop)]
        # The blocks that begin beyond the grid.
        beyond = sum(losses * f * (1 + 2 / (rate * packets * spacing_s)) for f, rate in falling)
        return float(ranked[:, :losses].sum()) * _ROUNDING + float(beyond)

    @staticmethod
    def _place(values: NDArray[np.float64], loop: int) -> int:
        """Return the index of a loop; loops that are alike have one value."""
        return loop if len(values) > 1 else 0

    @cached_property
    def _kernels(self) -> tuple[KernelBounds, Mapping[str, KernelBounds]]:
        """The kernel g and the k of every output, over all times."""
        return self.plant.error.kernels[Output.GAIN], self.plant.forced

    @cached_property
    def _until_s(self) -> Vector:
        """End of the grid, (loops,): beyond half of it, all kernels are bounded by exponentials."""
        g, forced = self._kernels
        ends_s = [kernel.edges_s[..., -1] for kernel in (g, *forced.values())]
        return np.atleast_1d(2 * np.max(np.broadcast_arrays(*ends_s), axis=0))

    @cached_property
    def _effects(self) -> Mapping[str, Matrix]:
        """The bound of c over each cell, (loops, cells), for every output."""
        until_s = self._until_s if len(self._until_s) > 1 else self._until_s[0]
        g, areas = self.plant.on_grid(until_s, _CELLS)
        numbers = np.arange(1, _CELLS + 1)
        g = np.where(numbers * (self._until_s[:, None] / _CELLS) > self.delay_s, g, 0.0)
        ages = np.maximum(g, np.pad(g[:, :-1], ((0, 0), (1, 0))))
        transform, size = np.fft.rfft(ages, 2 * _CELLS), np.linalg.norm(ages, axis=-1)
        effects = {}
        for output, area in areas.items():
            convolved = np.fft.irfft(np.fft.rfft(area, 2 * _CELLS) * transform)[..., :_CELLS]
            rounding = _TRANSFORMED * np.linalg.norm(area, axis=-1) * size
            effects[output] = np.maximum(convolved, 0.0) + rounding[:, None]
        return effects

    @cached_property
    def _beyond(self) -> Mapping[str, NDArray[np.float64]]:
        """Bounds of the losses older than the grid, for every output, (loops, 2, 2).

        A falling function of age, sup over T/2 and its rate for each of both terms. The blocks that
        begin beyond the grid contribute at most m f(T) + m/block ∫_T^∞ f.
        """
        g, forced = self._kernels
        half_s = self._until_s / 2
        by_output = {}
        for output, k in forced.items():
            levels = (g, g.tail_highest * k.integral()), (k, k.tail_area * g.sup())
            terms = [
                np.broadcast_arrays(
                    level * np.exp(-kernel.tail_rate_per_s * (half_s - kernel.edges_s[..., -1])),
                    kernel.tail_rate_per_s,
                )
                for kernel, level in levels
            ]
            by_output[output] = np.moveaxis(np.array(terms), -1, 0)
        return by_output


def _over_bins(cells: Vector, per_bin: float, bins: int) -> Vector:
    """Return the largest value of the cells that meet each bin; a bin has ``per_bin`` cells."""
    edges = np.minimum(np.floor(np.arange(bins + 1) * per_bin), len(cells) - 1).astype(np.int64)
    return np.asarray(np.maximum(np.maximum.reduceat(cells, edges[:-1]), cells[edges[1:]]))
