"""What a receiver misses, and what a guarantee allows, by definition; no rule of netem is used.

An outcome is 1 for a lost and 0 for a delivered datagram. Before the first one, all are delivered.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from netem.impairments.constraints.at_most import AtMost
from netem.impairments.constraints.recovery import Recovery
from netem.impairments.link_settings import LinkSettings


def outcomes_of(decisions: NDArray[Any]) -> NDArray[np.bool_]:
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


def longest_burst(lost: NDArray[np.bool_]) -> int:
    """Return the largest number of consecutive losses."""
    ends = np.flatnonzero(np.concatenate([[True], ~lost, [True]]))
    return int(np.diff(ends).max()) - 1


def allowed_rows(lost: NDArray[np.bool_], settings: LinkSettings) -> NDArray[np.bool_]:
    """Whether each row of (rows, n) outcomes fulfils the guarantee in all windows and gaps."""
    lost = np.pad(lost, ((0, 0), (1, 0)))
    count, n = np.cumsum(lost, axis=1), lost.shape[1]
    allowed = np.ones(len(lost), bool)
    windows = [
        (constraint.losses, constraint.window)
        for constraint in settings.constraints
        if isinstance(constraint, AtMost)
    ]
    if settings.mansd is not None:
        windows.append((settings.mansd, settings.mansd + 1))
    for losses, window in windows:
        begins = np.maximum(np.arange(n) - window, 0)
        allowed &= (count - count[:, begins] <= losses).all(axis=1)
    for constraint in settings.constraints:
        if isinstance(constraint, Recovery):
            for later in range(2, constraint.deliveries + 1):  # two bursts, later - 1 deliveries apart
                ends = lost[:, :-later] & lost[:, later:]
                apart = count[:, later:] - count[:, :-later] == 1
                allowed &= ~(ends & apart).any(axis=1)
    return allowed


def is_allowed(lost: Sequence[bool] | NDArray[np.bool_], settings: LinkSettings) -> bool:
    """The same for one sequence."""
    return bool(allowed_rows(np.array([lost], bool), settings)[0])
