"""The sequences of outcomes that a guarantee allows, from its definition; no rule of netem is used.

An outcome is 1 for a lost and 0 for a delivered datagram. Before the first one, all are delivered.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from noack.impairments.constraints.at_most import AtMost
from noack.impairments.constraints.recovery import Recovery
from noack.impairments.link_settings import LinkSettings


def allowed_rows(lost: NDArray[np.bool_], settings: LinkSettings) -> NDArray[np.bool_]:
    """Whether each row of (rows, n) outcomes fulfils the guarantee in all windows and gaps."""
    lost = np.pad(lost, ((0, 0), (1, 0)))
    count, n = np.cumsum(lost, axis=1), lost.shape[1]
    allowed = np.ones(len(lost), bool)
    windows = [(one.losses, one.window) for one in settings.constraints if isinstance(one, AtMost)]
    if settings.mansd is not None:
        windows.append((settings.mansd, settings.mansd + 1))
    for losses, window in windows:
        begins = np.maximum(np.arange(n) - window, 0)
        allowed &= (count - count[:, begins] <= losses).all(axis=1)
    for one in settings.constraints:
        if isinstance(one, Recovery):
            for later in range(2, one.deliveries + 1):  # two bursts, later - 1 deliveries apart
                ends = lost[:, :-later] & lost[:, later:]
                apart = count[:, later:] - count[:, :-later] == 1
                allowed &= ~(ends & apart).any(axis=1)
    return allowed


def is_allowed(lost: Sequence[bool], settings: LinkSettings) -> bool:
    """The same for one sequence."""
    return bool(allowed_rows(np.array([lost], bool), settings)[0])
