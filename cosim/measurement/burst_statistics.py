"""Statistics of loss bursts: histogram, the M of a quantile, (m, K) table."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom

from cosim.measurement.confidence_interval import LEVEL
from cosim.measurement.loss_bursts import Flags, LossBursts

WINDOWS = (2, 5, 10, 20, 50, 100, 200, 500, 1000)
"""K of the (m, K) table."""


@dataclass(frozen=True)
class QuantileM:
    """The paper's M (at most M − 1 consecutive losses) for a share of bursts or packets."""

    share: float
    bursts: int
    """Smallest M with at least this share of the loss bursts not longer than M − 1."""
    bursts_confident: int | None
    """The same for the network's bursts, if they are independent, with confidence 95 %; None: too
    few bursts."""
    packets: int
    """Smallest M such that at least this share of the packets end no more than M − 1 consecutive
    losses."""


def histogram(bursts: LossBursts) -> dict[int, int]:
    """Return the number of bursts by length."""
    lengths, counts = np.unique(bursts.length, return_counts=True)
    return dict(zip(lengths.tolist(), counts.tolist(), strict=True))


def quantile_m(bursts: LossBursts, share: float) -> QuantileM:
    """Return M for a share; without bursts it is 1."""
    ordered = np.sort(bursts.length)
    count = len(ordered)
    place = math.ceil(share * count - 1e-9)
    # P(at most rank − 1 of the bursts are in the share) ≥ 95 % (Wilks, 1941)
    rank = int(binom.ppf(LEVEL, count, share)) + 1
    confident = int(ordered[rank - 1]) + 1 if rank <= count else None
    return QuantileM(
        share,
        int(ordered[place - 1]) + 1 if place > 0 else 1,
        confident,
        _packet_quantile(bursts, share),
    )


def _packet_quantile(bursts: LossBursts, share: float) -> int:
    """Return the smallest M with Σ max(length − (M − 1), 0) ≤ (1 − share) packets."""
    allowed = math.floor((1 - share) * bursts.packets + 1e-9)
    low, high = 0, bursts.longest
    while low < high:
        middle = (low + high) // 2
        if int(np.maximum(bursts.length - middle, 0).sum()) <= allowed:
            high = middle
        else:
            low = middle + 1
    return low + 1


def most_losses(
    bursts: LossBursts, windows: Sequence[int], left_out: Flags | None = None
) -> dict[int, int]:
    """Return the largest number of losses in any K consecutive packets, by K.

    Windows that touch a burst that is left out do not count; a K without a window has no entry.
    """
    lost = _before(bursts)
    skipped = None if left_out is None or not left_out.any() else _before(bursts.only(left_out))
    found = {}
    for window in (one for one in windows if one <= bursts.packets):
        most = lost[window:] - lost[:-window]
        if skipped is not None:
            most = most[skipped[window:] == skipped[:-window]]
        if len(most):
            found[window] = int(most.max())
    return found


def _before(bursts: LossBursts) -> NDArray[np.int32]:
    """Return the number of losses before each of the k packets, and in all, (k + 1,)."""
    steps = np.zeros(bursts.packets + 1, np.int32)
    steps[bursts.first] = 1
    steps[bursts.end] -= 1
    return np.append(np.int32(0), np.cumsum(np.cumsum(steps[:-1]), dtype=np.int32))
