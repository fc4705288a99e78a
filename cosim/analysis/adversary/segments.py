"""Computes segments: from each of many states to its next event, with the objective's value.

Cells, polynomials and crossings are those of :mod:`cosim.simulation.continuous.continuous_loop`;
here they are computed for all states at once.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.adversary.objective import Measure
from cosim.analysis.adversary.polynomial_curves import curve_stack, powers
from cosim.analysis.adversary.segment_objective import (
    SegmentObjective,
    SquareIntegral,
    Supremum,
    columns,
)
from cosim.simulation.continuous.continuous_loop import ContinuousLoop
from cosim.simulation.continuous.exact_flow import DEGREE, taylor_terms
from noack.core.linear_systems import Matrix, Vector

_LARGEST = 1e100
_SLACK = 1e-13


class Segments(NamedTuple):
    """The ends of N segments: the next event, or the horizon."""

    end_s: Vector
    """(N,)"""
    z: Matrix
    """(x, e_s, e_c) at the end, before any reset, (N, 3n)."""
    is_event: NDArray[np.bool_]
    """Whether the segment ends in an event, not at the horizon or by divergence, (N,)."""
    value: Vector
    """The segment's value, (N,); infinite if the loop diverged."""


class SegmentFlow:
    """Follows states to their next events.

    Args:
        system: the loop.
        measure: the objective that evaluates a segment.
        horizon_s: end of the runs.
        known_start: sensor and controller start from x(0), so there is no event at t = 0.
    """

    def __init__(
        self,
        system: ContinuousLoop,
        measure: Measure,
        horizon_s: float,
        *,
        known_start: bool = False,
    ) -> None:
        self.system, self.measure, self.horizon_s = system, measure, horizon_s
        self.known_start = known_start
        trigger = system.decaying
        self._floor_from_s = (
            math.log(trigger.beta / trigger.floor) / trigger.alpha_per_s
            if trigger.floor > 0
            else math.inf
        )
        late_rate = 0.0 if measure.floor else measure.rate_per_s
        self._decaying = _Phase(system, measure, trigger.alpha_per_s, measure.rate_per_s)
        self._floored = _Phase(system, measure, 0.0, late_rate)

    def __call__(self, t_s: Vector, z: Matrix, known: float = -math.inf) -> Segments:
        """Follow N states to their next events.

        Args:
            t_s: their times, at most the horizon, (N,).
            z: (x, e_s, e_c), (N, 3n).
            known: results below this value may be inaccurate.
        """
        count, measure = len(t_s), self.measure
        found = Segments(
            t_s.copy(), z.copy(), np.zeros(count, bool), np.full(count, measure.nothing)
        )
        first_until_s = min(self._floor_from_s, self.horizon_s)
        for phase, from_s, until_s in (
            (self._decaying, -math.inf, first_until_s),
            (self._floored, self._floor_from_s, self.horizon_s),
        ):
            now = (found.end_s >= from_s) & (found.end_s < until_s) & ~found.is_event
            these = np.flatnonzero(now & (found.value < math.inf))
            part = phase.follow(found.end_s[these], found.z[these], until_s, known)
            found.value[these] = measure.joined(found.value[these], part.value)
            found.end_s[these], found.z[these], found.is_event[these] = part[:3]
        if measure.output is None:
            between_events = found.is_event & ((t_s > 0) | (not self.known_start))
            return found._replace(value=np.where(between_events, t_s - found.end_s, -math.inf))
        return found


class _Phase:
    """An interval with exponential decay of threshold and level, at ``alpha`` and ``rate``."""

    def __init__(
        self, system: ContinuousLoop, measure: Measure, alpha_per_s: float, rate_per_s: float
    ) -> None:
        n, generator, trigger = system.loop.n, system.generator, system.decaying
        self._system, self._measure = system, measure
        self._alpha_per_s, self._rate_per_s = alpha_per_s, rate_per_s
        self._width_s = system.flow.width_s
        self._across = system.flow.powers[1].T
        self._curves = curve_stack(DEGREE)
        self._state = columns(taylor_terms(generator, self._width_s))
        weight = np.eye(n) if trigger.weight is None else trigger.weight
        identity = np.eye(3 * n)
        scaled = taylor_terms(generator + alpha_per_s * identity, self._width_s)
        error = weight @ scaled[:, n : 2 * n]
        self._error = columns(error)
        self._control = columns(np.tensordot(self._curves.from_taylor, error, 1))
        self._slack = _SLACK * max(float(np.abs(self._control).sum(axis=0).max()), 1.0)
        self._worth: SegmentObjective | None = None
        if measure.output is not None:
            terms = taylor_terms(generator + rate_per_s * identity, self._width_s)
            output = measure.output @ terms
            self._worth = (
                SquareIntegral(output, self._width_s) if measure.additive else Supremum(output)
            )

    def follow(self, t_s: Vector, z: Matrix, until_s: float, known: float) -> Segments:
        """Follow states at times below ``until_s``."""
        count, width_s, measure = len(t_s), self._width_s, self._measure
        nothing = np.full(count, measure.nothing)
        found = Segments(np.full(count, until_s), z.copy(), np.zeros(count, bool), nothing)
        span = (until_s - t_s) / width_s
        trigger = self._system.decaying
        decaying = trigger.beta * np.exp(-trigger.alpha_per_s * t_s)
        threshold = np.maximum(decaying, trigger.floor)
        level = measure.level(t_s)
        going, cell = np.arange(count), 0
        while len(going):
            scale = math.exp(self._alpha_per_s * width_s * cell) / threshold[going]
            sane = np.abs(z).max(axis=1) * np.maximum(scale, 1.0) < _LARGEST
            if not sane.all():
                lost = going[~sane]
                found.value[lost], found.end_s[lost] = math.inf, t_s[lost] + cell * width_s
                going, z, scale = going[sane], z[sane], scale[sane]
            until = np.minimum(span[going] - cell, 1.0)
            exits = self._exits(z * scale[:, None])
            crossed = exits <= until
            until[crossed] = exits[crossed]
            these = going[crossed]
            found.is_event[these] = True
            found.end_s[these] = t_s[these] + (cell + until[crossed]) * width_s
            if self._worth is not None:
                fallen = math.exp(self._rate_per_s * width_s * cell) / level[going]
                so_far = found.value[going]
                worth = self._worth(z * fallen[:, None], until, np.maximum(so_far, known))
                found.value[going] = measure.joined(so_far, worth)
            ended = crossed | (span[going] <= cell + 1)
            found.z[going[ended]] = self._within(z[ended], until[ended])
            going, z = going[~ended], z[~ended] @ self._across
            cell += 1
        return found

    def _exits(self, scaled: Matrix) -> Vector:
        """Return where W e_s / threshold leaves the unit ball in the cell, (N,); NaN if nowhere."""
        shape = (-1, DEGREE + 1, self._system.loop.n)
        control = (scaled @ self._control).reshape(shape)
        reach = np.einsum("aki,aki->ak", control, control).max(axis=1)
        largest = np.abs(scaled).max(axis=1)
        near = np.flatnonzero(reach > 1.0 - self._slack * (1.0 + largest))
        exits = np.full(len(scaled), np.nan)
        exits[near] = self._curves.first_exits((scaled[near] @ self._error).reshape(shape))
        return exits

    def _within(self, z: Matrix, u: Vector) -> Matrix:
        """Return the state at position u ∈ [0, 1] of the cell."""
        terms = (z @ self._state).reshape(len(z), DEGREE + 1, z.shape[1])
        return np.asarray(np.einsum("ak,aki->ai", powers(u, DEGREE), terms))
