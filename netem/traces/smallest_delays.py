"""The smallest delays of a trace, which show the clocks: their slope, and steps that last.

Delays whose sending times are of another clock, or are planned by a constant period, are known up to a
straight line only, the lower envelope of the measured ones. A step of it is a clock that was set, a sender
that paused, a new route, or a queue that stays full.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from netem.core.row_operations import firsts_of_equal

Int64s = NDArray[np.int64]
Reals = NDArray[np.float64]
_BUCKETS = 4096
"""Parts of the time, of which each has its smallest delay."""
FEWEST = 64
"""With fewer packets steps cannot be told."""
_MOST_BLOCKS, SMALLEST_BLOCK = 50, 16
_FEW = 8
"""A step shows within so many packets; so many must be before it, and after it."""
_LASTS = 4
"""A step lasts for so many windows, or to the end."""
SMALLEST_STEP_NS = 1e6
_MOST_STEPS = 20


def envelope_slope(t: Int64s, y: Int64s) -> float:
    """Return the slope of the lower envelope of points (t, y); ``t`` does not descend.

    The line a·t + b below all points with the smallest Σ(y − a·t − b) has the largest value at the
    mean of t. So it is the edge of the lower convex hull above this place.
    """
    if t[0] == t[-1]:
        return 0.0
    mean = float(np.mean(t.astype(float)))
    kept = _lowest_of_each_bucket(t, y)
    hull: list[tuple[float, float]] = []
    for point in zip(t[kept].astype(float).tolist(), y[kept].astype(float).tolist(), strict=True):
        while len(hull) > 1 and _cross(hull[-2], hull[-1], point) <= 0:
            hull.pop()
        hull.append(point)
    rising = [(b[1] - a[1]) / (b[0] - a[0]) for a, b in pairwise(hull) if b[0] >= mean and b[0] > a[0]]
    return rising[0] if rising else 0.0


def _cross(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _lowest_of_each_bucket(t: Int64s, y: Int64s) -> Int64s:
    """Return the places of the lowest point in each of 4096 parts of the time, ascending."""
    width = (int(t[-1]) - int(t[0])) // _BUCKETS + 1
    bucket = (t - t[0]) // width
    order = np.lexsort((y, bucket))
    return np.sort(order[firsts_of_equal(bucket[order])])


class DelayStep(NamedTuple):
    """A change of the smallest delay that lasts."""

    place: int  # Of the first packet after it
    size_ns: float


def block_edges(count: int) -> Int64s:
    """Return the edges of equal blocks of packets."""
    return np.linspace(0, count, min(_MOST_BLOCKS, count // SMALLEST_BLOCK) + 1).astype(np.int64)


def steady_slope(planned_ns: Reals, delay_ns: Reals) -> tuple[float, float]:
    """Return the slope of the smallest delays, which a few steps do not change, and its standard error.

    It is the median of the slopes from block to block.

    Args:
        planned_ns: (n,) Times of sending, ascending, of at least :data:`FEWEST` packets.
        delay_ns: (n,) Measured delays.
    """
    edges = block_edges(len(planned_ns))
    lowest = np.array([a + int(delay_ns[a:b].argmin()) for a, b in pairwise(edges)])
    apart_ns = np.maximum(np.diff(planned_ns[lowest]), 1.0)
    slopes = np.diff(delay_ns[lowest]) / apart_ns
    slope = float(np.median(slopes))
    return slope, 1.5 * float(np.median(np.abs(slopes - slope))) / len(slopes) ** 0.5


def steps_text(steps: Sequence[DelayStep], at_ns: Int64s) -> str:
    """Return the largest of some steps, and how many more there are, for a line.

    Args:
        steps: the steps.
        at_ns: (n,) times of the packets.
    """
    largest = max(steps, key=lambda step: abs(step.size_ns))
    more = f", and at {len(steps) - 1} other times" if len(steps) > 1 else ""
    at_s = at_ns[largest.place] / 1e9
    return f"the smallest delay changes by {largest.size_ns / 1e6:+.1f} ms at {at_s:.6g} s{more}"


def find_steps(planned_ns: Reals, delay_ns: Reals, smallest_ns: float = 0.0) -> list[DelayStep]:
    """Return the steps of the smallest delay, in their order; at most 20.

    Args:
        planned_ns: (n,) Times of sending, ascending.
        delay_ns: (n,) Measured delays, up to a straight line.
        smallest_ns: smaller steps are none.
    """
    count = len(planned_ns)
    if count < FEWEST:
        return []
    slope, slope_error = steady_slope(planned_ns, delay_ns)
    level = delay_ns - slope * (planned_ns - planned_ns[0])
    window = max(2 * count // _MOST_BLOCKS, SMALLEST_BLOCK)
    change, near = _changes(level, window), _changes(level, _FEW)
    usual_ns, most_ns = spreads(level)
    least_ns = max(SMALLEST_STEP_NS, smallest_ns, 6 * float(np.median(np.abs(change))), usual_ns)
    is_sharp = (np.abs(change) > least_ns) & (change * near > change**2 / 2)
    steps: list[DelayStep] = []
    for place in (np.flatnonzero(is_sharp) + _FEW).tolist():
        # The first of the places from which a step shows is the nearest to it, up to a few packets.
        if steps and place < steps[-1].place + window // 2:
            continue
        here = slice(max(place - _FEW, _FEW), place + _FEW + 1)
        sharpest = int(np.abs(near[here.start - _FEW : here.stop - _FEW]).argmax()) + here.start
        size_ns = _lasting(planned_ns, level, sharpest, window)
        is_at_end = min(sharpest, count - sharpest) < window
        if size_ns < 0 and sharpest < window:
            continue  # a queue that empties when the trace begins
        gap_ns = planned_ns[sharpest] - planned_ns[sharpest - 1]
        by_slope_ns = 4 * slope_error * gap_ns
        if abs(size_ns) > (max(least_ns, most_ns) if is_at_end else least_ns) + by_slope_ns:
            steps.append(DelayStep(sharpest, size_ns))
            if len(steps) == _MOST_STEPS:
                break
    return steps


def _changes(level: Reals, window: int) -> Reals:
    """Return min(after) − min(before) at the places from 8 to n − 8."""
    from scipy.ndimage import minimum_filter1d  # a slow import

    size = min(window, len(level) // 2)
    after = minimum_filter1d(level, size, origin=-(size // 2), mode="nearest")
    before = minimum_filter1d(level, size, origin=(size - 1) // 2, mode="nearest")
    return np.asarray(after[_FEW : len(level) - _FEW + 1] - before[_FEW - 1 : len(level) - _FEW])


def spreads(level: Reals) -> tuple[float, float]:
    """Return how far the median and 90 % of the delays usually are above the smallest one of their block."""
    edges = block_edges(len(level))
    blocks = [np.quantile(level[a:b], (0, 0.5, 0.9)) for a, b in pairwise(edges)]
    low, median, high = np.array(blocks).T
    return float(np.median(median - low)), float(np.median(high - low))


def _lasting(planned_ns: Reals, level: Reals, place: int, window: int) -> float:
    """Return the change of the smallest delay at a place that lasts; 0 if it does not last.

    Packets that have waited for each other show the smallest delay only behind the last of them.
    """
    begin = max(place - _LASTS * window, 0)
    before_ns = float(level[begin:place].min())
    waited_ns = max(float(level[place : place + _FEW].min()) - before_ns, 0.0)
    until_ns = planned_ns[place] + waited_ns
    end = int(np.searchsorted(planned_ns, until_ns)) + _LASTS * window
    return float(level[place:end].min()) - before_ns
