"""Histograms of times, which the core counts (``native/relay/events.c``)."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from noack.core.core_library import core

_STEP_BITS = 5
_STEPS = 1 << _STEP_BITS
_JOINED = 8
BUCKETS: int = core.NOACK_BUCKETS
"""Number of buckets. The last one also counts all longer times: 4.8 hours and more."""


def bucket_start_ns(bucket: int) -> int:
    """Return the shortest time of a bucket."""
    if bucket < _STEPS:
        return bucket
    shift = (bucket >> _STEP_BITS) - 1
    return (_STEPS + (bucket & (_STEPS - 1))) << shift


def coarse_histogram(counts: NDArray[np.int64]) -> list[list[int]]:
    """Return a coarser histogram for people and plots: four buckets for each doubling.

    Each entry is the shortest time in ns and the count of a bucket that is not empty.
    """
    joined = counts.reshape(-1, _JOINED).sum(axis=1)
    return [[bucket_start_ns(_JOINED * k), int(joined[k])] for k in np.flatnonzero(joined).tolist()]


def quantile_ns(counts: Sequence[int] | NDArray[np.int64], share: float) -> float:
    """Return the quantile of a level in ns, accurate to 3 %; nan if the histogram is empty."""
    reached = np.cumsum(counts)
    if reached[-1] == 0:
        return float("nan")
    bucket = int(np.searchsorted(reached, max(share * reached[-1], 1)))
    return (bucket_start_ns(bucket) + bucket_start_ns(bucket + 1) - 1) / 2
