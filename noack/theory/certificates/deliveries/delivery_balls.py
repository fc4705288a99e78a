"""Balls that contain x at the delivered events, and a return of their centres.

A delivered event at a time t, in steps of the gaps, has ‖ξ − c‖ ≤ ρ in coordinates ξ = Λx, and late
effects S of the updates in flight (``delivery_gaps.py``). Besides both, the largest ρ + θS is kept.
What follows is linear in ρ and S and does not fall, so it is largest at one of two corners of what
all three permit.

A return: as the loop is linear, what follows from ξ(t) = κ c(t − m) + r is κ times what followed
from c(t − m), and what follows from r.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix, Vector
from noack.theory.bounds.stacked_norms import ROUNDING, Stack

_LAGS = 64
"""Number of lags m that are tried; the norms of all of them are one product."""


class Ball(NamedTuple):
    """Bounds of ρ, S, and ρ + θS at a delivered event."""

    centre: Vector
    """c, (n,)."""
    radius: float
    """ρ"""
    late_effects: float
    """S"""
    weighted_sum: float
    """ρ + θS"""
    theta: float
    time: int = 0
    """In steps of the gaps."""

    @property
    def corners(self) -> list[list[float]]:
        """ρ and S where linear functions of both, that do not fall, are largest, (2, corners)."""
        radius = min(self.radius, self.weighted_sum)
        late_effects = min(self.late_effects, self.weighted_sum / self.theta)
        late_effects_at_radius = max(min(late_effects, (self.weighted_sum - radius) / self.theta), 0.0)
        radius_at_late_effects = max(min(radius, self.weighted_sum - self.theta * late_effects), 0.0)
        return [
            [radius * ROUNDING, radius_at_late_effects * ROUNDING],
            [late_effects_at_radius * ROUNDING, late_effects * ROUNDING],
        ]


class BallHistory(NamedTuple):
    """The balls of all times; NaN where there is none."""

    centres: Matrix
    late_effects: Vector
    weighted_sums: Vector

    @classmethod
    def without_balls(cls, times: int, n: int) -> "BallHistory":
        """Return a history of some times without a ball."""
        return cls(*(np.full(shape, np.nan) for shape in ((times, n), times, times)))

    def add(self, balls: Sequence[Ball]) -> None:
        """Add balls at their times."""
        times = [ball.time for ball in balls]
        self.centres[times] = [ball.centre for ball in balls]
        self.late_effects[times] = [ball.late_effects for ball in balls]
        self.weighted_sums[times] = [ball.weighted_sum for ball in balls]

    def last_return(self, last: slice) -> tuple[float, float] | None:
        """Return |κ|, and ‖r‖ + ρ + θS at most, of ξ(t) = κ c(t − m) + r at the last times t.

        Of the m that are tried, the one with the smallest (‖r‖ + ρ + θS)/(1 − |κ|) is used. None: no |κ| is
        below 1.
        """
        times = np.arange(last.start, last.stop)[~np.isnan(self.weighted_sums[last])]
        lags = np.unique(np.linspace(len(self.centres[last]), last.start - 1, _LAGS).astype(int))
        # κ of least squares for each m, and its largest rest.
        earlier = self.centres[times - lags[lags > 0, None]]  # (m, times, n)
        now = self.centres[times]
        kappas = (earlier * now).sum(axis=(1, 2)) / np.square(earlier).sum(axis=(1, 2))
        residuals = lengths(now - kappas[:, None, None] * earlier) + 1e-12 * lengths(now)
        rests = (residuals + self.weighted_sums[times]).max(axis=1)
        kappas = np.abs(kappas)
        bounds = np.where(kappas < 1, rests / (1 - kappas), np.nan)
        if np.isnan(bounds).all():
            return None
        best = int(np.nanargmin(bounds))
        return float(kappas[best]), float(rests[best])


class BallsAfterGaps(NamedTuple):
    """The balls after each gap, for delivered events at some times."""

    centres: Stack
    """c, (times, gaps, n)."""
    extents: Stack
    """ρ, S, and ρ + θS, (times, gaps, 3)."""


class RecentBalls:
    """The balls after each gap from the last times, as far back as the longest gap."""

    def __init__(self, counts: NDArray[np.int64], start_balls: BallsAfterGaps) -> None:
        self._counts, self._gaps = counts, np.arange(len(counts))
        self._longest = int(counts[-1])
        slots = self._longest + 1
        self._slots_after_gaps = np.add.outer(np.arange(slots), counts) % slots
        self._balls = BallsAfterGaps(*(np.zeros((slots, *array.shape[1:])) for array in start_balls))
        """By the time to which they lead, modulo the number of slots."""
        self._has_balls = [False] * slots
        """By the time from which balls lead on, likewise."""
        self._last_time_without = -1
        self.store([0], start_balls)

    def leading_to(self, time: int) -> tuple[Matrix, Matrix] | None:
        """Return centres and extents of the balls at a time, one for each gap; None if there is none.

        They may be changed, as they are used once.
        """
        slots = len(self._has_balls)
        centres, extents = self._balls.centres[time % slots], self._balls.extents[time % slots]
        if time - self._longest > self._last_time_without:
            return centres, extents
        has_balls = [self._has_balls[(time - count) % slots] for count in self._counts.tolist()]
        return (centres[has_balls], extents[has_balls]) if any(has_balls) else None

    def forget(self, times: Sequence[int]) -> None:
        """Remove the balls after gaps from some times, which have no balls now."""
        for time in times:
            self._has_balls[time % len(self._has_balls)] = False
            self._last_time_without = time

    def store(self, times: list[int], balls: BallsAfterGaps) -> None:
        """Store the balls after gaps from some times."""
        slots = [time % len(self._has_balls) for time in times]
        places = self._slots_after_gaps[slots], self._gaps
        self._balls.centres[places], self._balls.extents[places] = balls
        for slot in slots:
            self._has_balls[slot] = True


def lengths(vectors: Stack) -> Stack:
    """Return ‖·‖ of vectors, (…, n)."""
    return np.asarray(np.sqrt(squared_lengths(vectors)))


def squared_lengths(vectors: Stack) -> Stack:
    """Return ‖·‖² of vectors, (…, n)."""
    return np.asarray(np.einsum("...n,...n->...", vectors, vectors))
