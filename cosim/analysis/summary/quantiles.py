"""Quantiles of any number of values, which arrive in parts.

:class:`QuantileSketch` keeps all values up to ``EXACT``. Beyond that it counts them in bins whose
width is ``RESOLUTION`` of their distance from 0, as an HDR histogram does. The smallest and the
largest value stay exact.
"""

from collections.abc import Iterable
from typing import Self

import numpy as np
from numpy.typing import NDArray

EXACT = 2**20
"""Number of values up to which quantiles are exact."""
RESOLUTION = 1e-3
"""Largest relative error of a quantile of more values."""
_SMALLEST = 1e-6
"""Values closer to 0 than this count as 0."""


class QuantileSketch:
    """Collects values in parts."""

    def __init__(self) -> None:
        self._values: list[NDArray[np.float64]] | None = []
        self._counts: dict[int, int] = {}
        self._low, self._high = np.inf, -np.inf
        self.count = 0
        """Number of values."""

    @classmethod
    def of(cls, parts: Iterable[NDArray[np.float64]]) -> Self:
        """Return a sketch of values in parts."""
        sketch = cls()
        for values in parts:
            sketch.add(values)
        return sketch

    def add(self, values: NDArray[np.float64]) -> None:
        """Add values, (k,); those that are not finite are ignored."""
        values = values[np.isfinite(values)]
        if not len(values):
            return
        self.count += len(values)
        self._low = min(self._low, float(values.min()))
        self._high = max(self._high, float(values.max()))
        if self._values is not None:
            self._values.append(values)
            if self.count <= EXACT:
                return
            values, self._values = np.concatenate(self._values), None
        bins, counts = np.unique(_bins(values), return_counts=True)
        for bin_number, count in zip(bins.tolist(), counts.tolist(), strict=True):
            self._counts[bin_number] = self._counts.get(bin_number, 0) + count

    def quantiles(self, *shares: float) -> list[float | None]:
        """Return the values below which some shares of all values are; None without values."""
        if not self.count:
            return [None] * len(shares)
        if self._values is not None:
            values = np.sort(np.concatenate(self._values))
            return list(quantiles_in(values, self.count, np.array(shares)).tolist())
        ranks = self.count - np.array(shares) * (self.count - 1)
        return list(self.largest(ranks).tolist())

    def largest(self, ranks: NDArray[np.float64] | NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the values of some ranks, (k,); that of rank 1 is the largest one."""
        if self._values is not None:
            values = np.sort(np.concatenate([np.zeros(0), *self._values]))
            return values[self.count - np.asarray(ranks, np.intp)]
        bins = np.array(sorted(self._counts))
        below = np.cumsum([self._counts[bin_number] for bin_number in bins.tolist()])
        at = np.searchsorted(below, self.count - np.asarray(ranks), side="right")
        values = _middle(bins[at.clip(max=len(bins) - 1)])
        values = np.where(np.asarray(ranks) <= 1, self._high, values)
        return np.asarray(np.clip(values, self._low, self._high))


def quantiles_in(
    ordered: NDArray[np.float64],
    counts: int | NDArray[np.int64],
    shares: NDArray[np.float64],
    *columns: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Return the same as ``np.quantile``, which takes several times as long for few values.

    Args:
        ordered: ascending values, (k,); or columns of them.
        counts: how many of them count; of each of the columns, (c,).
        shares: (s,); for columns, (s, 1).
        columns: the numbers of c columns.
    """
    positions = shares * (counts - 1)
    before = np.floor(positions).astype(np.intp)
    after = np.minimum(before + 1, counts - 1)
    low, high = ordered[(before, *columns)], ordered[(after, *columns)]
    part, apart = positions - before, high - low
    return np.asarray(np.where(part < 0.5, low + apart * part, high - apart * (1 - part)))


def _bins(values: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the number of each value's bin; 0 is that of 0."""
    sizes = np.abs(values)
    with np.errstate(divide="ignore"):
        bins = 1 + np.floor(np.log(sizes / _SMALLEST) / np.log1p(RESOLUTION))
    return (np.sign(values) * np.where(sizes < _SMALLEST, 0, bins)).astype(np.int64)


def _middle(bins: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the geometric middle of each bin."""
    return np.sign(bins) * _SMALLEST * (1 + RESOLUTION) ** (np.abs(bins) - 0.5)
