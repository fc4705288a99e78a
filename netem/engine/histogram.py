"""A histogram of times: 32 buckets for each doubling, so that a bucket is at most 3 % wide.

It is an array of counts, (BUCKETS,); bucket k counts the times t with lower_ns(k) ≤ t <
lower_ns(k + 1). The core counts (native/relay/events.c).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from noack.core.core_library import core

_STEP_BITS = 5
_STEPS = 1 << _STEP_BITS
_JOINED = 8
BUCKETS: int = core.NOACK_BUCKETS
"""Number of buckets. The last one also counts all longer times: 4.8 hours and more."""


def lower_ns(bucket: int) -> int:
    """Return the shortest time of a bucket."""
    if bucket < _STEPS:
        return bucket
    shift = (bucket >> _STEP_BITS) - 1
    return (_STEPS + (bucket & (_STEPS - 1))) << shift


def coarse(counts: NDArray[np.int64]) -> list[list[int]]:
    """Return a coarser histogram for people and plots: four buckets for each doubling.

    Each entry is the shortest time in ns and the count of a bucket that is not empty.
    """
    joined = counts.reshape(-1, _JOINED).sum(axis=1)
    return [[lower_ns(_JOINED * k), int(joined[k])] for k in np.flatnonzero(joined).tolist()]


def empty() -> NDArray[np.int64]:
    """Return an empty histogram, (BUCKETS,)."""
    return np.zeros(BUCKETS, dtype=np.int64)


def quantile_ns(counts: Sequence[int] | NDArray[np.int64], share: float) -> float:
    """Return the quantile of a level in ns, accurate to 3 %; nan if the histogram is empty."""
    reached = np.cumsum(counts)
    if reached[-1] == 0:
        return float("nan")
    bucket = int(np.searchsorted(reached, max(share * reached[-1], 1)))
    return (lower_ns(bucket) + lower_ns(bucket + 1) - 1) / 2
