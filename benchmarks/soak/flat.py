"""When memory counts as flat.

The warm-up is left out: the first fifth of a run, five minutes at the most. The rest is cut into
twelve windows. Of each only the lower median counts, so that what is allocated for a moment does
not; the slope is the median of the slopes between all pairs of windows (Theil and Sen), so that
four windows out of twelve may be anything, or missing. Memory

* **grows** if by this slope it gained more than 1 MiB, or in a run that is longer than an hour more
  than 1 MiB per hour;
* **creeps** if in half an hour or more nine in ten pairs of windows rise, by 256 KiB in all: what
  leaks is steady, what a cache or an allocator takes is not;
* is **flat** otherwise.

A run of less than half an hour may gain 9.5 MiB, as the recorder's memory goes up and down by 9: in
the four minutes that one of five leaves, at 500 Hz, that is 83 bytes a step, so that a row that is
kept shows; what leaks at events alone takes the longer run. Nothing is said of less than two
minutes after the warm-up.
"""

import math
from collections.abc import Sequence
from itertools import combinations, pairwise
from typing import Literal, NamedTuple

WARM_UP_SHARE, LONGEST_WARM_UP_S = 0.2, 300.0
WINDOWS, LEAST_WINDOWS = 12, 8
ALLOWED_KIB = 1024.0
"""In all, and per hour where that is more."""
SHORT_S, SHORT_ALLOWED_KIB, LEAST_S = 1800.0, 9728.0, 120.0
STEADY_KIB, STEADY_SHARE, STEADY_FROM_S = 256.0, 0.9, 1800.0

Word = Literal["flat", "grows", "creeps", "unknown", "too short"]


class Trend(NamedTuple):
    """How memory went over a run."""

    at_10_kib: float
    at_50_kib: float
    at_100_kib: float
    """At so many per cent of the run."""
    slope_kib_per_h: float
    """NaN of too few samples."""
    growth_kib: float
    """By the slope, from the end of the warm-up on."""
    allowed_kib: float
    rising: float
    """Share of the pairs of windows that rise."""
    verdict: Word


def warm_up_s(length_s: float) -> float:
    """How much of a run is not judged."""
    return min(WARM_UP_SHARE * length_s, LONGEST_WARM_UP_S)


def trend(at_s: Sequence[float], kib: Sequence[float], length_s: float) -> Trend:
    """Judge memory over a run.

    Args:
        at_s: when it was looked at, from the run's start, rising.
        kib: what was seen.
        length_s: of the run.
    """
    at_10, at_50, at_100 = (_near(at_s, kib, share * length_s) for share in (0.1, 0.5, 1.0))
    begin_s = warm_up_s(length_s)
    judged_s = length_s - begin_s
    allowed_kib = ALLOWED_KIB * max(judged_s / 3600, 1.0)
    if length_s < SHORT_S:
        allowed_kib = SHORT_ALLOWED_KIB
    windows: list[list[tuple[float, float]]] = [[] for _ in range(WINDOWS)]
    for at, value in zip(at_s, kib, strict=True):
        if begin_s <= at <= length_s:
            place = int((at - begin_s) / judged_s * WINDOWS)
            windows[min(place, WINDOWS - 1)].append((at, value))
    if judged_s < LEAST_S:
        return Trend(at_10, at_50, at_100, math.nan, math.nan, allowed_kib, math.nan, "too short")
    seen = [window for window in windows if window]
    if len(seen) < LEAST_WINDOWS:
        return Trend(at_10, at_50, at_100, math.nan, math.nan, allowed_kib, math.nan, "unknown")
    middles = [
        (_low_median([at for at, _ in window]), _low_median([value for _, value in window]))
        for window in seen
    ]
    pairs = list(combinations(middles, 2))
    slope = _low_median([(b - a) / (t - s) for (s, a), (t, b) in pairs])
    rising = sum(b > a for (_, a), (_, b) in pairs) / len(pairs)
    growth_kib = slope * judged_s
    steady = (
        rising >= STEADY_SHARE
        and growth_kib > STEADY_KIB * max(judged_s / 3600, 1.0)
        and judged_s >= STEADY_FROM_S * (1 - WARM_UP_SHARE)
    )
    verdict: Word = "grows" if growth_kib > allowed_kib else "creeps" if steady else "flat"
    return Trend(
        at_10, at_50, at_100, 3600 * slope, growth_kib, allowed_kib, rising, verdict
    )  # fmt: skip


def constant(at_s: Sequence[float], counts: Sequence[int], length_s: float) -> tuple[int, int]:
    """Least and most of a count after the warm-up, but for what a single look saw."""
    judged = [
        count
        for at, count in zip(at_s, counts, strict=True)
        if warm_up_s(length_s) <= at <= length_s
    ]
    lasting = [a for a, b in pairwise(judged) if a == b] or judged
    return (min(lasting), max(lasting)) if lasting else (0, 0)


def _near(at_s: Sequence[float], kib: Sequence[float], when_s: float) -> float:
    found = min(
        zip(at_s, kib, strict=True), key=lambda sample: abs(sample[0] - when_s), default=None
    )
    return math.nan if found is None else found[1]


def _low_median(values: Sequence[float]) -> float:
    return sorted(values)[(len(values) - 1) // 2]
