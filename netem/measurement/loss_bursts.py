"""Effective losses of a packet trace, and the bursts of consecutive ones.

A packet is effective (``docs/mansd.md``) if it is received within the deadline, before every later
packet. A receiver that uses only the newest data misses all others.

The statistics of bursts follow: histogram, quantiles, (m, K) table.
"""

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from netem.core.clock import NEVER_NS
from netem.measurement.interval_estimates import LEVEL
from netem.traces.packet_trace import LOST_NS, Int64s, PacketTrace

Flags = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Outcomes:
    """What became of the k packets of a trace: each is in one of four groups."""

    lost: Flags
    """(k,) Never received."""
    out_of_order: Flags
    """(k,) Received after a later packet."""
    late: Flags
    """(k,) Received in order, but after the deadline."""
    newer_ns: Int64s
    """(k,) When the first later packet was received; the greatest integer if none was."""

    @property
    def effective(self) -> Flags:
        """(k,) Received in order, within the deadline."""
        return ~(self.lost | self.out_of_order | self.late)


def outcomes(trace: PacketTrace, deadline_ns: int | None = None) -> Outcomes:
    """Return what became of each packet.

    Of packets that are received at the same time, the one with the lower number is the first. If
    one is received within the deadline, a later packet that arrives before it is, too: whether late
    packets make others stale makes no difference.
    """
    lost = trace.received_ns == LOST_NS
    received_ns = np.where(lost, NEVER_NS, trace.received_ns)
    newer_ns = np.append(np.minimum.accumulate(received_ns[::-1])[::-1][1:], NEVER_NS)
    out_of_order = ~lost & (received_ns > newer_ns)
    late = np.zeros(len(lost), bool)
    if deadline_ns is not None:
        late = ~lost & ~out_of_order & (trace.received_ns - trace.sent_ns > deadline_ns)
    return Outcomes(lost, out_of_order, late, newer_ns)


@dataclass(frozen=True, eq=False)
class LossBursts:
    """The b bursts of consecutive effective losses among k packets."""

    packets: int
    """k"""
    first: Int64s
    """(b,) Index of the first lost packet."""
    length: Int64s
    """(b,)"""

    @property
    def end(self) -> Int64s:
        """(b,) Index of the packet after the last lost one."""
        return self.first + self.length

    @property
    def complete(self) -> Flags:
        """(b,) Whether the burst began and ended within the trace."""
        return (self.first > 0) & (self.end < self.packets)

    @property
    def losses(self) -> int:
        """Number of effective losses."""
        return int(self.length.sum())

    @property
    def longest(self) -> int:
        """Length of the longest burst; 0 if there is none."""
        return int(self.length.max(initial=0))

    def deliveries(self) -> Int64s:
        """(b + 1,) Deliveries before, between and after the bursts; the ends may be 0."""
        ends = np.append(self.first, self.packets)
        return np.asarray(ends - np.append(0, self.end))

    def subset(self, selection: Flags) -> "LossBursts":
        """Return some of the bursts."""
        return LossBursts(self.packets, self.first[selection], self.length[selection])

    def times_s(self, trace: PacketTrace) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return when each burst began, and how long it lasted, (b,) each.

        It lasts from the sending of its first packet to that of the next effective packet, or to
        the last sending.
        """
        next_index = np.minimum(self.end, self.packets - 1)
        begin_ns = trace.sent_ns[self.first]
        durations_ns = trace.sent_ns[next_index] - begin_ns
        return np.asarray(begin_ns * 1e-9), np.asarray(durations_ns * 1e-9)


def loss_bursts(effective: Flags) -> LossBursts:
    """Return the bursts of consecutive packets that are not effective."""
    steps = np.diff(np.concatenate([[1], effective.view(np.int8), [1]]))
    first = np.flatnonzero(steps < 0)
    return LossBursts(len(effective), first, np.flatnonzero(steps > 0) - first)


WINDOWS = (2, 5, 10, 20, 50, 100, 200, 500, 1000)
"""K of the (m, K) table."""


@dataclass(frozen=True)
class BurstQuantile:
    """The largest number of losses in a row for a share of bursts or packets."""

    share: float
    bursts: int
    """At least this share of the loss bursts is not longer."""
    bursts_confident: int | None
    """The same for the network's bursts, if they are independent, with confidence 95 %; None: too
    few bursts."""
    packets: int
    """At least this share of the packets ends no longer burst."""


def histogram(bursts: LossBursts) -> dict[int, int]:
    """Return the number of bursts by length."""
    lengths, counts = np.unique(bursts.length, return_counts=True)
    return dict(zip(lengths.tolist(), counts.tolist(), strict=True))


def burst_quantile(bursts: LossBursts, share: float) -> BurstQuantile:
    """Return the largest number of losses in a row for a share; without bursts it is 0."""
    lengths = np.sort(bursts.length)
    count = len(lengths)
    index = math.ceil(share * count - 1e-9)
    # P(at most rank − 1 of the bursts are in the share) ≥ 95 % (Wilks, 1941)
    rank = int(stats.binom.ppf(LEVEL, count, share)) + 1
    confident = int(lengths[rank - 1]) if rank <= count else None
    return BurstQuantile(
        share, int(lengths[index - 1]) if index > 0 else 0, confident, _packet_quantile(bursts, share)
    )


def _packet_quantile(bursts: LossBursts, share: float) -> int:
    """Return the smallest N with Σ max(length − N, 0) ≤ (1 − share) packets."""
    allowed_losses = math.floor((1 - share) * bursts.packets + 1e-9)

    def is_enough(allowed_burst: int) -> bool:
        return int(np.maximum(bursts.length - allowed_burst, 0).sum()) <= allowed_losses

    return bisect_left(range(bursts.longest), True, key=is_enough)


def most_losses(bursts: LossBursts, windows: Sequence[int], left_out: Flags | None = None) -> dict[int, int]:
    """Return the largest number of losses in any K consecutive packets, by K.

    Windows that touch a burst that is left out do not count; a K without a window has no entry.
    """
    lost = _losses_before(bursts)
    losses_left_out = (
        None if left_out is None or not left_out.any() else _losses_before(bursts.subset(left_out))
    )
    by_window = {}
    for window in windows:
        if window > bursts.packets:
            continue
        losses = lost[window:] - lost[:-window]
        if losses_left_out is not None:
            losses = losses[losses_left_out[window:] == losses_left_out[:-window]]
        if len(losses):
            by_window[window] = int(losses.max())
    return by_window


def _losses_before(bursts: LossBursts) -> NDArray[np.int32]:
    """Return the number of losses before each of the k packets, and in all, (k + 1,)."""
    steps = np.zeros(bursts.packets + 1, np.int32)
    steps[bursts.first] = 1
    steps[bursts.end] -= 1
    return np.append(np.int32(0), np.cumsum(np.cumsum(steps[:-1]), dtype=np.int32))
