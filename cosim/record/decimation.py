"""Curves with fewer points, whose plots are the same."""

import numpy as np
from numpy.typing import NDArray

from netem.core.row_operations import firsts_of_equal
from noack.scenario.scenario import Scenario

Reals = NDArray[np.float64]
Indices = NDArray[np.intp]

_POINTS_PER_COLUMN = 4
_MOST_STEPS = 2**20
"""Steps of the plant that a recording for the viewer shows one by one."""


def decimate(t: Reals, y: Reals, columns: int) -> Indices:
    """Select the points that a plot of y over t needs at a width of ``columns`` pixels.

    These are the first, the last, the smallest and the largest value of each column: a line through
    them covers the same pixels (Jugel et al. 2014, *M4*), and no peak is lost.

    Args:
        t: (k,), ascending.
        y: (k,); NaN is a gap and stays one unless it is narrower than a column.
        columns: width of the plot.

    Returns:
        At most 4 ``columns`` indices, ascending; all k indices if k is not larger.
    """
    k = len(t)
    if k <= _POINTS_PER_COLUMN * columns:
        return np.arange(k)
    span = t[-1] - t[0]
    scale = columns / span if span > 0 else 0.0
    column = np.minimum(((t - t[0]) * scale).astype(np.intp), columns - 1)
    first = firsts_of_equal(column)
    last = np.append(first[1:], k) - 1
    low = _where_first(np.fmin.reduceat(y, first), y, column, first, last)
    high = _where_first(np.fmax.reduceat(y, first), y, column, first, last)
    return np.unique(np.concatenate([first, last, low, high]))


def decimate_all(t: Reals, values: Reals, columns: int) -> Indices:
    """Select the points that plots of several curves need, values (k, n) over t."""
    if len(t) <= _POINTS_PER_COLUMN * columns:
        return np.arange(len(t))
    indices = [decimate(t, np.ascontiguousarray(curve), columns) for curve in values.T]
    return np.unique(np.concatenate(indices))


def _where_first(extreme: Reals, y: Reals, column: Indices, first: Indices, last: Indices) -> Indices:
    """Return the index of each column's first value that equals its extreme."""
    equal = np.flatnonzero(y == np.repeat(extreme, last - first + 1))
    _, first_index = np.unique(column[equal], return_index=True)
    indices: Indices = equal[first_index]
    return indices


def is_long(scenario: Scenario) -> bool:
    """Whether a run has too many steps to show all of them.

    Its recording is written from the record, reduced to the extremes of short intervals.
    """
    return scenario.timing.horizon_ns // scenario.timing.plant_period_ns > _MOST_STEPS
