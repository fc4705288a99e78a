"""Delays of the received packets: their distribution, and their correlation by distance."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from noack.traces.packet_trace import PacketTrace

Reals = NDArray[np.float64]
SHARES = (0.0, 0.05, 0.5, 0.9, 0.95, 0.99, 0.999, 1.0)
_MOST_LAGS, _LARGEST_LAG = 40, 1000
_FEWEST_PAIRS = 30
_MOST_RANKED = 1_000_000
"""Number of packets, the first ones, of which correlations are computed."""


@dataclass(frozen=True)
class DelayStatistics:
    """Delays in seconds; empty if no packet was received."""

    received: int
    quantiles_s: dict[float, float]
    """By share of the received packets."""
    lags: tuple[int, ...]
    """Distances in packets."""
    correlation: tuple[float, ...]
    """Correlation of the normal scores of the delays of two packets at each lag: scores have only
    the ranks of the delays, so a few very long ones do not outweigh all others. The emulator's
    ``delay … CORRELATION`` is this correlation at lag 1."""
    white: float
    """Size below which 95 % of the correlations of independent delays are."""


def delay_statistics(trace: PacketTrace) -> DelayStatistics:
    """Return the statistics of the packets that were received, in order or not."""
    arrived = ~trace.lost
    delays_ns = trace.delay_ns[arrived]
    if not len(delays_ns):
        return DelayStatistics(0, {}, (), (), 0.0)
    quantiles = np.quantile(delays_ns, SHARES) * 1e-9
    lags, correlation = autocorrelation(trace.delay_ns, arrived)
    return DelayStatistics(
        len(delays_ns),
        dict(zip(SHARES, quantiles.tolist(), strict=True)),
        lags,
        correlation,
        1.96 / np.sqrt(len(delays_ns)),
    )


def normal_scores(values: NDArray[np.int64]) -> Reals:
    """Return Φ⁻¹ of the middle ranks of values, equal ones with the same rank, scaled, (k,)."""
    _, place, counts = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(counts)
    scores = ndtri((last - counts / 2) / len(values))[place]
    deviation = scores.std()
    return np.asarray((scores - scores.mean()) / deviation if deviation > 0 else 0.0 * scores)


def autocorrelation(
    values: NDArray[np.int64], known: NDArray[np.bool_]
) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Return lags and the correlation of the normal scores of the known ones of k values."""
    values, known = values[:_MOST_RANKED], known[:_MOST_RANKED]
    if not known.any():
        return (), ()
    scores = np.zeros(len(known))
    scores[known] = normal_scores(values[known])
    if not scores.any():
        return (), ()
    furthest = max(min(_LARGEST_LAG, len(known) // 4), 1)
    lags, found = [], []
    for lag in np.unique(np.geomspace(1, furthest, _MOST_LAGS).round()).astype(int).tolist():
        pairs = int(np.count_nonzero(known[lag:] & known[:-lag]))
        if pairs >= _FEWEST_PAIRS:
            lags.append(lag)
            found.append(float(scores[lag:] @ scores[:-lag] / pairs))
    return tuple(lags), tuple(found)
