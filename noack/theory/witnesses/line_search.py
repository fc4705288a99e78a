"""The search for the lowest value of a function of a share, with few values, of which some are infinite."""

from collections.abc import Callable, Iterable, Mapping
from math import inf, isfinite, log

import numpy as np

_STEP = 1.5
_SMALL_GAIN = 0.01


def search_lowest(
    value: Callable[[float], float],
    first: float,
    most: int,
    *,
    upwards: bool,
    moves: Iterable[int] = (0, -1, 1, -2, 2),
) -> None:
    """Call a function at shares between 0 and 1: downhill from a first one, then where a parabola is lowest.

    Args:
        value: the function; it is at least 0, or infinite, and called once for each share.
        first: the first share.
        most: calls, without the last one.
        upwards: the second share is above the first one.
        moves: steps from the first share, until there is a finite value.
    """
    known: dict[float, float] = {}

    def size(share: float) -> float:
        if share not in known:
            known[share] = value(share) if len(known) < most else inf
        return known[share]

    share = next((s for k in moves if isfinite(size(s := _moved(first, k)))), None)
    if share is None:
        return
    step = 1 if upwards else -1
    if size(_moved(share, step)) > size(share):
        step = -step
    while size(following := _moved(share, step)) < size(share):
        share = following
    if min(known.values()) <= 0:  # nothing is lower: a loop that starts at rest
        return
    lowest = _lowest_point({s: log(v) for s, v in known.items() if isfinite(v)})
    if lowest is not None:
        value(lowest)


def _moved(share: float, steps: int) -> float:
    """Return the share after some steps up or down; it stays below 1."""
    for _ in range(steps):
        share = min(share * _STEP, (share + 1) / 2)
    return share * _STEP ** min(steps, 0)


def _lowest_point(logarithms: Mapping[float, float]) -> float | None:
    """Return the lowest point of the parabola through the three lowest, if it promises to be much lower."""
    shares = sorted(sorted(logarithms, key=lambda share: logarithms[share])[:3])
    if len(shares) < 3:
        return None
    fit = np.polyfit(shares, [logarithms[share] for share in shares], 2)
    if fit[0] <= 0:
        return None
    lowest = float(np.clip(-fit[1] / (2 * fit[0]), shares[0] / 2, (shares[-1] + 1) / 2))
    gain = min(logarithms.values()) - float(np.polyval(fit, lowest))
    return lowest if gain > _SMALL_GAIN else None
