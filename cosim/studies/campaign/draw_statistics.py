"""Estimates of a metric from the draws of a grid point, with confidence intervals.

Means have Student's confidence intervals, ± t s/√k. Mean and interval use the finite values only.
The median's interval uses order statistics (binomial, for any distribution). It includes infinite
values: a run that never settles counts as later than all others.
"""

import math
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Vector

CONFIDENCE = 0.95
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
"""A quantile is the smallest value that at least this share of the draws does not exceed."""


class Estimate(NamedTuple):
    """A metric over k draws."""

    draws: int
    finite: int
    """Number of draws with a finite metric; mean and interval use only these."""
    mean: float
    halfwidth: float
    """Half-width of the mean's 95 % confidence interval."""
    q05: float
    q25: float
    median: float
    q75: float
    q95: float
    median_low: float
    """Lower end of the median's 95 % confidence interval."""
    median_high: float
    largest: float


def estimate(values: Vector, finite: Vector | None = None) -> Estimate:
    """Estimate a metric from its values in k ≥ 1 draws, (k,), without NaN.

    Mean and interval use ``finite``, by default all finite values.
    """
    finite = values[np.isfinite(values)] if finite is None else finite
    mean, halfwidth = float(finite.mean()) if len(finite) else math.inf, math.inf
    if len(finite) > 1:
        with np.errstate(over="ignore"):  # the interval of numbers beyond 1e150 is infinite
            deviation = float(finite.std(ddof=1))
        halfwidth = _student(len(finite)) * deviation / math.sqrt(len(finite))
    q05, q25, median, q75, q95 = _quantiles(values, QUANTILES)
    low, high = quantile_interval(values, 0.5)
    largest = float(values.max())
    return Estimate(
        len(values), len(finite), mean, halfwidth, q05, q25, median, q75, q95, low, high, largest
    )


class Quartiles(NamedTuple):
    """Quartiles of a metric; each is the value of a draw, possibly infinite."""

    lower: float
    median: float
    upper: float


def quartiles(values: Vector) -> Quartiles:
    """Return lower quartile, median and upper quartile of k ≥ 1 draws, (k,)."""
    return Quartiles(*_quantiles(values, (0.25, 0.5, 0.75)))


def paired(values: Vector, reference: Vector) -> Vector:
    """Return ``values`` − ``reference`` draw by draw; 0 if both are infinite."""
    with np.errstate(invalid="ignore"):
        return np.where(values == reference, 0.0, values - reference)


class PairedDifference(NamedTuple):
    """Difference of a metric between two grid points, draw by draw."""

    estimate: Estimate
    larger: float
    """Share of the draws in which the metric is larger than at the reference."""
    smaller: float
    """Share of the draws in which the metric is smaller than at the reference."""


def difference(values: Vector, reference: Vector) -> PairedDifference:
    """Estimate ``values`` − ``reference``, (k,) each.

    If both are infinite, the quantiles use a difference of 0, and the mean omits the draw.
    """
    differences = paired(values, reference)
    both = np.isfinite(values) & np.isfinite(reference)
    return PairedDifference(
        estimate(differences, differences[both]),
        float((values > reference).mean()),
        float((values < reference).mean()),
    )


@cache
def _student(count: int) -> float:
    """Return Student's factor t for the mean of this number of values."""
    from scipy.special import stdtrit

    return float(stdtrit(count - 1, (1 + CONFIDENCE) / 2))


def _quantiles(values: Vector, shares: Sequence[float]) -> list[float]:
    return [float(value) for value in np.quantile(values, shares, method="inverted_cdf")]


def quantile_interval(values: Vector, share: float) -> tuple[float, float]:
    """Return the ends of a quantile's 95 % confidence interval; ±inf if no draw bounds it."""
    ordered = np.append(np.sort(values), math.inf)
    low, high = interval_ranks(len(values), share)
    return float(ordered[low]) if low >= 0 else -math.inf, float(ordered[high])


def interval_ranks(count: int, share: float) -> tuple[int, int]:
    """Return the ranks, from 0, of the ends of a quantile's 95 % confidence interval.

    They are −1 and ``count`` if no draw bounds the quantile.
    """
    from scipy.stats import binom

    # The j-th smallest draw, from 1, exceeds the quantile if fewer than j draws lie below it.
    tail = (1.0 - CONFIDENCE) / 2
    low, high = (int(binom.ppf(level, count, share)) for level in (tail, 1.0 - tail))
    return low - 1, min(high, count)
