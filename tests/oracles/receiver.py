"""What a receiver that uses only the newest datagram misses; nothing of netem's rules is used."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Outcomes = NDArray[np.bool_]


class Limits(NamedTuple):
    """A guarantee in numbers."""

    windows: tuple[tuple[int, int], ...]
    """(m, K): at most m losses among K; a cap M − 1 is (M − 1, M)."""
    recovery: int = 0


def outcomes_of(decisions: NDArray[Any]) -> Outcomes:
    """Return (k,) whether each datagram of a flow is lost, from its decisions in order.

    A datagram is lost if no intact copy of it leaves, or if a later one leaves before it.
    """
    numbers = np.arange(len(decisions))
    times, leaving = [], []
    for departure, bit in (("release_ns", "bit"), ("copy_ns", "copy_bit")):
        intact = (decisions[departure] >= 0) & (decisions[bit] < 0)
        times.append(decisions[departure][intact])
        leaving.append(numbers[intact])
    # Datagrams with equal release times leave in the order of arrival.
    in_order = np.concatenate(leaving)[np.lexsort((np.concatenate(leaving), np.concatenate(times)))]
    newest = np.maximum.accumulate(np.concatenate([[-1], in_order]))
    lost = np.ones(len(decisions), bool)
    lost[in_order[in_order > newest[:-1]]] = False
    return lost


def longest_burst(lost: Outcomes) -> int:
    """Return the largest number of consecutive losses."""
    ends = np.flatnonzero(np.concatenate([[True], ~lost, [True]]))
    return int(np.diff(ends).max()) - 1


def violations(lost: Outcomes, limits: Limits) -> int:
    """Count the windows with too many losses, and the gaps between bursts that are too short."""
    count = np.concatenate([[0], np.cumsum(lost)])
    found = 0
    for losses, window in limits.windows:
        begin = np.maximum(np.arange(1, len(count)) - window, 0)
        found += int(np.count_nonzero(count[1:] - count[begin] > losses))
    gaps = np.diff(np.flatnonzero(lost)) - 1
    return found + int(np.count_nonzero((gaps > 0) & (gaps < limits.recovery)))
