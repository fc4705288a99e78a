"""Decides whether a process's memory is flat.

The warm-up is ignored: the first fifth of a run, at most five minutes. The rest is divided into
twelve windows. Each window counts with its lower median, which ignores short allocations. The slope
is the median of the slopes between all pairs of windows (Theil and Sen), so that four of the twelve
windows may be outliers or missing. Memory

* **grows** if this slope gives a gain of more than 1 MiB, or, in a run longer than an hour, of more
  than 1 MiB per hour;
* **creeps** if, in half an hour or more, at least nine in ten pairs of windows rise and the total
  gain is at least 256 KiB: a leak is steady, the memory of a cache or an allocator is not;
* is **flat** otherwise.

A run of less than half an hour may gain 9.5 MiB, since the recorder's memory varies by 9 MiB. In
the four minutes that a run of five minutes leaves, at 500 Hz, this is 83 bytes per step, so that a
leak of one row per step is detected. A leak per event needs a longer run. With less than two
minutes after the warm-up, there is no verdict.
"""

import math
from collections.abc import Sequence
from itertools import combinations, pairwise
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

WARM_UP_SHARE, LONGEST_WARM_UP_S = 0.2, 300.0
WINDOWS, LEAST_WINDOWS = 12, 8
ALLOWED_KIB = 1024.0
"""Allowed total growth, and allowed growth per hour in runs longer than an hour."""
SHORT_S, SHORT_ALLOWED_KIB, LEAST_S = 1800.0, 9728.0, 120.0
STEADY_KIB, STEADY_SHARE, STEADY_FROM_S = 256.0, 0.9, 1800.0

Values = NDArray[np.float64]
Word = Literal["flat", "grows", "creeps", "unknown", "too short"]


class Trend(NamedTuple):
    """The trend of memory over a run."""

    at_10_kib: float
    at_50_kib: float
    at_100_kib: float
    """Memory at this percentage of the run."""
    slope_kib_per_h: float
    """NaN if there are too few samples."""
    growth_kib: float
    """Growth since the end of the warm-up, from the slope."""
    allowed_kib: float
    rising: float
    """Share of the pairs of windows that rise."""
    verdict: Word


def warm_up_s(length_s: float) -> float:
    """Return the length of the warm-up, which is not judged."""
    return min(WARM_UP_SHARE * length_s, LONGEST_WARM_UP_S)


def trend(at_s: Sequence[float], kib: Sequence[float], length_s: float) -> Trend:
    """Judge memory over a run.

    Args:
        at_s: times of the samples since the run's start, ascending.
        kib: the samples.
        length_s: length of the run.
    """
    shares = (_near(at_s, kib, share * length_s) for share in (0.1, 0.5, 1.0))
    begin_s = warm_up_s(length_s)
    judged_s = length_s - begin_s
    hours = max(judged_s / 3600, 1.0)
    allowed_kib = SHORT_ALLOWED_KIB if length_s < SHORT_S else ALLOWED_KIB * hours
    windows: list[list[tuple[float, float]]] = [[] for _ in range(WINDOWS)]
    for at, value in zip(at_s, kib, strict=True):
        if begin_s <= at <= length_s:
            place = int((at - begin_s) / judged_s * WINDOWS)
            windows[min(place, WINDOWS - 1)].append((at, value))
    medians = [_low_median(np.array(window)) for window in windows if window]
    if judged_s < LEAST_S or len(medians) < LEAST_WINDOWS:
        verdict: Word = "too short" if judged_s < LEAST_S else "unknown"
        return Trend(*shares, math.nan, math.nan, allowed_kib, math.nan, verdict)
    apart = np.array([after - before for before, after in combinations(medians, 2)])
    slope = float(_low_median(apart[:, 1] / apart[:, 0]))
    rising, growth_kib = float((apart[:, 1] > 0).mean()), slope * judged_s
    steady = (
        rising >= STEADY_SHARE
        and growth_kib > STEADY_KIB * hours
        and judged_s >= STEADY_FROM_S * (1 - WARM_UP_SHARE)
    )
    verdict = "grows" if growth_kib > allowed_kib else "creeps" if steady else "flat"
    return Trend(*shares, 3600 * slope, growth_kib, allowed_kib, rising, verdict)


def constant(at_s: Sequence[float], counts: Sequence[int], length_s: float) -> tuple[int, int]:
    """Return minimum and maximum of a count after the warm-up, ignoring single outliers."""
    judged = [
        count
        for at, count in zip(at_s, counts, strict=True)
        if warm_up_s(length_s) <= at <= length_s
    ]
    lasting = [a for a, b in pairwise(judged) if a == b] or judged
    return (min(lasting), max(lasting)) if lasting else (0, 0)


def _near(at_s: Sequence[float], kib: Sequence[float], when_s: float) -> float:
    return kib[int(np.abs(np.subtract(at_s, when_s)).argmin())] if len(kib) else math.nan


def _low_median(values: Values) -> Values:
    return np.quantile(values, 0.5, axis=0, method="lower")
