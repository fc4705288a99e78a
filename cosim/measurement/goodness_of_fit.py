"""Pearson's χ² test of the lengths of loss bursts, and of the deliveries between them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from cosim.measurement.loss_bursts import Flags, LossBursts
from cosim.measurement.loss_likelihood import ChainRates

SIGNIFICANCE = 0.01
"""Level at which a model is called rejected."""
FEWEST_EXPECTED = 5.0
"""Smallest expected count of a class; smaller ones are merged."""


@dataclass(frozen=True)
class FitTest:
    """The result of a test."""

    statistic: float | None
    degrees: int
    p_value: float | None
    """None: too few data for the test."""

    @property
    def verdict(self) -> str:
        """In a word."""
        if self.p_value is None:
            return "too few bursts to test"
        return "rejected" if self.p_value < SIGNIFICANCE else "not rejected"

    @property
    def figures(self) -> str:
        """Statistic, degrees of freedom, and p."""
        if self.p_value is None:
            return ""
        return f"χ² = {self.statistic:.4g}, {self.degrees} d.f., p = {self.p_value:.2g}"


def length_test(bursts: LossBursts, left_out: Flags, rates: ChainRates, parameters: int) -> FitTest:
    """Test whether the lengths of bursts and deliveries follow a model with fitted parameters.

    Lengths that the trace, or a burst that is left out, cuts are not counted. The classes are
    chosen from the expected counts alone.
    """
    deliveries = bursts.deliveries()[1:-1][~left_out[1:] & ~left_out[:-1]]
    lengths = ((bursts.length[bursts.complete & ~left_out], True), (deliveries, False))
    statistic, degrees = 0.0, -parameters
    for observed, lost in lengths:
        value, classes = _pearson(observed, rates, lost)
        statistic, degrees = statistic + value, degrees + classes - 1
    if degrees < 1:
        return FitTest(None, max(degrees, 0), None)
    return FitTest(statistic, degrees, float(chi2.sf(statistic, degrees)))


def _pearson(observed: NDArray[np.int64], rates: ChainRates, lost: bool) -> tuple[float, int]:
    """Return χ² and the number of classes."""
    count = len(observed)
    edges = _edges(rates, lost, count)
    tails = np.append(rates.survival(lost=lost)(edges.astype(float)), 0.0)
    expected = -np.diff(tails) * count
    found = np.histogram(observed, np.append(edges, np.iinfo(np.int64).max))[0]
    return float(((found - expected) ** 2 / np.maximum(expected, 1e-300)).sum()), len(edges)


def _edges(rates: ChainRates, lost: bool, count: int) -> NDArray[np.int64]:
    """Return the smallest length of each class: each class expects enough lengths."""
    longest = 1
    survival = rates.survival(lost=lost)
    while count * survival(np.array([longest]))[0] >= FEWEST_EXPECTED and longest < 2**40:
        longest *= 2
    # Lengths that are worth an edge: all short ones, then ever coarser ones.
    grid = np.unique(np.geomspace(1, longest, 400).round().astype(np.int64))
    tails = count * survival(grid.astype(float))
    edges, share = [1], max(FEWEST_EXPECTED, count / 20)
    for length, tail in zip(grid.tolist()[1:], tails.tolist()[1:], strict=True):
        begun = count * survival(np.array([edges[-1]]))[0]
        if begun - tail >= share and tail >= FEWEST_EXPECTED:
            edges.append(length)
    return np.array(edges)
