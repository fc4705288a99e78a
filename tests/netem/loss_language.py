"""The sequences of outcomes that a guarantee allows, from its definition; no rule of netem is used.

An outcome is 1 for a lost and 0 for a delivered datagram. Before the first one, all are delivered.
"""

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from noack.impairments.constraints.at_most import AtMost
from noack.impairments.constraints.recovery import Recovery
from noack.impairments.link_settings import LinkSettings


def is_allowed(lost: Sequence[bool], settings: LinkSettings) -> bool:
    """Whether each window and each gap between two loss bursts fulfils the guarantee."""
    text = "".join("1" if one else "0" for one in lost)
    if settings.mansd is not None and "1" * (settings.mansd + 1) in text:
        return False
    for one in settings.constraints:
        if isinstance(one, AtMost):
            counts = (text[at : at + one.window].count("1") for at in range(len(text)))
            if max(counts, default=0) > one.losses:
                return False
        elif isinstance(one, Recovery):
            gaps = re.findall("(?<=1)0+(?=1)", text)
            if min(map(len, gaps), default=one.deliveries) < one.deliveries:
                return False
    return True


def allowed_rows(lost: NDArray[np.bool_], settings: LinkSettings) -> NDArray[np.bool_]:
    """The same for each row of (rows, n) outcomes."""
    lost = np.pad(lost, ((0, 0), (1, 0)))
    count, n = np.cumsum(lost, axis=1), lost.shape[1]
    allowed = np.ones(len(lost), bool)
    windows = [(one.losses, one.window) for one in settings.constraints if isinstance(one, AtMost)]
    if settings.mansd is not None:
        windows.append((settings.mansd, settings.mansd + 1))
    for losses, window in windows:
        for end in range(1, n):
            within = count[:, end] - count[:, max(end - window, 0)]
            allowed &= within <= losses
    for one in settings.constraints:
        if isinstance(one, Recovery):
            for gap in range(1, one.deliveries):
                for first in range(n - gap - 1):
                    last = first + gap + 1
                    both = lost[:, first] & lost[:, last]
                    allowed &= ~(both & (count[:, last] - count[:, first] == 1))
    return allowed
