"""Bounds of a trigger rule for certificates: of e_s after its tests, and of times between events.

Every rule is data (:mod:`noack.trigger_policies.trigger_rule`), so the bounds follow from its fields:

* a comparison bounds ‖e_s‖_W ≤ threshold + shares of x (:func:`comparison_bound`);
* one of the integral, ∫‖e_s‖_W ≤ δ, bounds ‖e_s‖_W ≤ δ/T at some time of the last T, for each T;
* until a dwell time has passed, and up to a deadline, e_s has grown from 0.

:class:`TriggerBounds` states these bounds.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from noack.core.clock import NS_PER_S
from noack.core.linear_systems import Matrix
from noack.core.number_format import number
from noack.theory.bounds.certificate_terms import (
    InterEventTimes,
    NetworkConditions,
    NoCertificateError,
    TriggerBound,
)
from noack.theory.bounds.stacked_norms import ROUNDING, spectral_norm
from noack.trigger_policies.trigger_rule import QuadraticForm, TriggerRule

_RELATIVE, _RESIDUAL = 1e-7, 1e-13
"""Least eigenvalue of a positive definite Q₂₂, and the error of a computed Q, as shares of ‖Q‖."""
_AVERAGED = 2.0 ** np.arange(-6, 5)
"""Times over which an integral is averaged, in time constants of the model."""
_NO_BOUND = (
    'where the rule does not transmit, e_s may still have any size; combine it with policy = "deadline"'
)
_EVENTS_ACCUMULATE = (
    "events may accumulate, since no threshold keeps them apart; "
    'test the rule at sampling times, or combine it with policy = "dwell"'
)


class ComparisonBound(NamedTuple):
    """‖W e_s‖ ≤ ``size`` · f + Σ ‖S x‖, after an event, or a comparison with f that was none."""

    size: float
    shares: tuple[Matrix, ...]
    """S, (k, n) each."""
    least: float
    """An event needs ‖W e_s‖ > ``least`` · f, unless it is due by its time; 0 if nothing is known.
    """
    has_root: bool = False
    """Whether ‖W e_s‖ ≤ (size² f² + ‖S₀ x‖²)^½ + Σ ‖S_i x‖, S₀ the first share, holds, too."""


def comparison_bound(rule: TriggerRule, weight: Matrix) -> ComparisonBound | None:
    """Return the bound of ‖W e_s‖ that the comparison of a rule sets; None if it sets none.

    It holds whatever the plant and the network do. Where the comparison was made and did not
    transmit, zᵀQz ≤ f², with z = (x, e_s), Q = PᵀP − NᵀN and the threshold f. Let Q₂₂ = FᵀF be its
    part on e_s, J = Q₂₂⁻¹Q₂₁, and CᵀC ⪰ Q₁₂J − Q₁₁. Then

        ‖F(e_s + Jx)‖² ≤ f² + ‖C x‖²,   so   ‖W e_s‖ ≤ ‖W F⁻¹‖ (f + ‖C x‖) + ‖W J x‖.

    If Q₂₂ is not positive definite, the comparison leaves e_s unbounded in some direction. The same
    holds with Girard's dynamic variable, and where the threshold is what the state was at the last event.

    ``weight`` is W, (n, n). A rule that integrates compares ∫‖P z‖ instead of ‖P z‖.
    """
    if rule.from_event or rule.dynamic_variable is not None:
        return None
    n, (positive, negative) = len(weight), rule.form
    if not len(positive):
        return None
    if positive[:, :n].any() or negative[:, n:].any():
        return _of_mixed_form(rule.form, weight)
    P, N = positive[:, n:], negative[:, :n]
    if np.array_equal(P, weight):
        return ComparisonBound(1.0, (N,) if N.any() else (), 1.0, bool(N.any()))
    if not _is_definite(P.T @ P, 1.0):
        return None
    size = float(np.linalg.norm(weight @ np.linalg.pinv(P), 2)) * ROUNDING
    least = 1 / (float(np.linalg.norm(P @ np.linalg.inv(weight), 2)) * ROUNDING)
    return ComparisonBound(size, (size * N,) if N.any() else (), least, bool(N.any()))


def _of_mixed_form(form: QuadraticForm, weight: Matrix) -> ComparisonBound | None:
    """Return the bound of a form that compares e_s together with x."""
    n = len(weight)
    Q = form.positive.T @ form.positive - form.negative.T @ form.negative
    size_of_Q = float(np.linalg.norm(form.positive, 2) ** 2 + np.linalg.norm(form.negative, 2) ** 2)
    if not _is_definite(Q[n:, n:], size_of_Q):
        return None
    J = np.linalg.solve(Q[n:, n:], Q[n:, :n])
    values, vectors = np.linalg.eigh(Q[:n, n:] @ J - Q[:n, :n])
    grown = values + _RESIDUAL / _RELATIVE * size_of_Q
    C = np.sqrt(grown[grown > 0])[:, None] * vectors.T[grown > 0]
    F = np.linalg.cholesky(Q[n:, n:]).T
    size = float(np.linalg.norm(weight @ np.linalg.inv(F), 2)) * ROUNDING
    shares = (size * C, ROUNDING * weight @ J)
    return ComparisonBound(size, tuple(S for S in shares if S.any()), 0.0, bool(C.any()))


def _is_definite(Q: Matrix, size: float) -> bool:
    """Return whether a symmetric Q is positive definite beyond rounding, (n, n)."""
    values = np.linalg.eigvalsh(Q)
    return bool(values[0] > _RELATIVE * max(size, float(values[-1])))


@dataclass(frozen=True)
class TriggerBounds:
    """The bounds of a rule in the norm ‖W e_s‖; W is ``weight``, (n, n)."""

    rule: TriggerRule
    weight: Matrix
    fastest_per_s: float
    """Rate of the model's fastest mode."""
    largest: float = math.inf
    """A bound of the ‖W x‖ that the rule compares, if one is known."""

    @cached_property
    def comparison(self) -> ComparisonBound | None:
        """The bound that follows from the comparison; None if there is none."""
        return comparison_bound(self.rule, self.weight)

    @property
    def beta(self) -> float:
        """β of a threshold βe^{−αt}; 0 without one."""
        return 0.0 if self.comparison is None else self.comparison.size * self.rule.level

    @property
    def alpha_per_s(self) -> float:
        """α."""
        return self.rule.fading_per_s if self.beta else 0.0

    @property
    def floor(self) -> float:
        """ε: the constant, or the floor, of the threshold; 0 without one."""
        if self.comparison is None or self.rule.integrates:
            return 0.0
        return self.comparison.size * self.rule.floor

    @property
    def area(self) -> float:
        """δ of ∫‖e_s‖_W ≤ δ; 0 if the rule does not integrate."""
        if self.comparison is None or not self.rule.integrates:
            return 0.0
        return self.comparison.size * self.rule.floor

    @property
    def is_homogeneous(self) -> bool:
        """Whether all bounds of e_s are multiples of bounds of x: a certificate may decay."""
        return not (self.beta or self.floor or self.area)

    @property
    def is_constant(self) -> bool:
        """Whether the threshold has a constant, and no part that decays."""
        return not self.beta and not self.is_homogeneous

    @property
    def outputs(self) -> Mapping[str, Matrix]:
        """S of each share sup‖S x‖ of the threshold, by name."""
        shares = () if self.comparison is None else self.comparison.shares
        return {f"share {number}": S for number, S in enumerate(shares)}

    @property
    def has_due_time(self) -> bool:
        """Whether events are at most some time apart."""
        return math.isfinite(self.rule.longest_ns)

    def conditions_of_tests(self, conditions: NetworkConditions) -> NetworkConditions:
        """Return the conditions with the times of the rule's comparisons.

        Raises:
            NoCertificateError: comparisons may be missed.
        """
        if not self.rule.grid_ns:
            return conditions
        grid_s, step_s = self.rule.grid_ns / NS_PER_S, conditions.spacing_s
        if conditions.sampling_s != step_s:
            raise NoCertificateError("the rule compares on a grid, and measurements there may be missing")
        grid_s = spacing_s = _rounded_up(grid_s, step_s)
        due_ns = self.rule.longest_ns
        if self.has_due_time and due_ns % self.rule.grid_ns:  # due between two points of the grid
            spacing_s = step_s or math.gcd(round(self.rule.grid_ns), round(due_ns)) / NS_PER_S
        return conditions._replace(sampling_s=grid_s, spacing_s=spacing_s)

    def bound(self, conditions: NetworkConditions, level: float, least_level: float | None) -> TriggerBound:
        """Return all bounds; their unit is the level, or 1 without one.

        Args:
            conditions: as :meth:`conditions_of_tests` returns them.
            level: the largest threshold, scaled.
            least_level: the smallest threshold; None if it may be arbitrarily small.

        Raises:
            NoCertificateError: nothing bounds e_s, or nothing separates events.
        """
        times, h_s = self._between_events(conditions), conditions.sampling_s
        idle_s = self._longest_until_test(self.rule.idle_ns, conditions)
        untested_s = max(idle_s - h_s, 0.0) if math.isfinite(idle_s) else 0.0
        bounds: list[TriggerBound] = []
        if self.comparison is not None:
            least_error: float | None = None
            if least_level is not None:
                least_error = least_level * self.comparison.least / self.comparison.size or None
            shares = {**dict.fromkeys(self.outputs, 1.0), **self._slope(level)}
            # Of the trapezoids of tests that may be missing, the oldest may count most.
            is_mean = self.area > 0 and h_s == conditions.spacing_s
            for window_s, beta, least in self._levels(conditions, level, least_error):
                bound = TriggerBound(
                    beta=beta,
                    least_event_error=least,
                    shares=shares,
                    untested_s=untested_s,
                    window_s=window_s,
                    is_mean=is_mean,
                    root_output=next(iter(shares)) if self.comparison.has_root else "",
                )
                # What enters is followed if there is one growth; two growths are smaller.
                bounds += [bound._replace(merges_growths=True), bound] if untested_s else [bound]
        if math.isfinite(times.longest_s):
            bounds.append(TriggerBound(0.0, None, untested_s=times.longest_s - h_s, is_tested=False))
        if not bounds:
            raise NoCertificateError(_NO_BOUND)
        # Events are apart by times, or because e_s has to grow.
        is_separated = times.shortest_s or conditions.spacing_s or any(b.least_event_error for b in bounds)
        grows_first = level > 0 and self.comparison is not None and self.comparison.least > 0
        if not is_separated and not grows_first:
            raise NoCertificateError(_EVENTS_ACCUMULATE)
        if self.is_homogeneous:
            times = times._replace(shortest_s=max(times.shortest_s, conditions.spacing_s))
        return bounds[0]._replace(unit=level or 1.0, times=times, further=tuple(bounds[1:]))

    def divide(
        self, conditions: NetworkConditions, inter_event_s: float
    ) -> list[tuple[TriggerBound, TriggerBound]]:
        """Return each bound without its constant, and with it, both in units of 1.

        Parts of the signals may be added only if they use the same bound. ``inter_event_s`` is a known
        lower bound of the inter-event time.

        Raises: as :meth:`bound`.
        """
        whole = self.bound(conditions, self.floor, self.floor or None)
        times = whole.times._replace(shortest_s=inter_event_s)
        alone = [
            bound._replace(times=times, unit=1.0, least_event_error=None, further=())
            for bound in whole.all_bounds
        ]
        return [(bound._replace(beta=0.0), bound) for bound in alone]

    def text(self) -> str:
        """Return in words how the rule bounds e_s."""
        bounds = []
        if (comparison := self.comparison) is not None:
            shares = " + ".join(
                f"{number(float(np.linalg.norm(S @ np.linalg.inv(self.weight), 2)))} ‖x‖"
                for S in comparison.shares
            )
            level = "" if self.is_homogeneous else "the threshold"
            bounded = "∫‖e_s‖ dt" if self.rule.integrates else "‖e_s‖"
            total = " + ".join(filter(None, [level, shares]))
            bounds.append(f"after each test {bounded} ≤ {total or '0'}")
        if self.has_due_time:
            longest_s = self.rule.longest_ns / NS_PER_S
            bounds.append(f"the next event at the latest {longest_s:g} s after the last one")
        return "; ".join(bounds)

    @property
    def has_chord(self) -> bool:
        """Whether a known bound of x makes that of e_s smaller."""
        return self.comparison is not None and self.comparison.has_root and self.is_constant

    def _slope(self, level: float) -> Mapping[str, float]:
        """Return a smaller factor of the first share: (f² + s²)^½ is below its chord over [0, S]."""
        if not self.has_chord or math.isinf(self.largest):
            return {}
        name, S = next(iter(self.outputs.items()))
        largest_norm = self.largest * float(spectral_norm(S @ np.linalg.inv(self.weight))) * ROUNDING
        return {name: (math.hypot(level, largest_norm) - level) / largest_norm * ROUNDING}

    def _levels(
        self, conditions: NetworkConditions, level: float, least_error: float | None
    ) -> list[tuple[float, float, float | None]]:
        """Return (T, β, least ‖e_s‖_W at an event): ‖e_s‖_W ≤ β at some time of the last T."""
        if not self.area:
            return [(0.0, level, least_error)]
        assert self.comparison is not None
        least = self.comparison.least * self.rule.floor
        test_s, longest_s = conditions.spacing_s, conditions.sampling_s
        times_s = _AVERAGED / self.fastest_per_s
        if test_s:  # the trapezoidal sum of the last k tests
            tests = sorted({math.ceil(t_s / test_s) for t_s in times_s})
            return [(k * longest_s, self.area / (k * test_s), least / (k * longest_s)) for k in tests]
        return [(t_s, self.area / t_s, least / t_s) for t_s in times_s.tolist()]

    def _between_events(self, conditions: NetworkConditions) -> InterEventTimes:
        rule = self.rule
        step_s = conditions.spacing_s
        return InterEventTimes(
            shortest_s=max(_rounded_up(rule.earliest_ns / NS_PER_S, step_s), conditions.apart_s),
            longest_s=self._longest_until_test(rule.longest_ns, conditions),
            earliest_due_s=_rounded_up(rule.longest_ns / NS_PER_S, step_s),
        )

    def _longest_until_test(self, time_ns: float, conditions: NetworkConditions) -> float:
        """Return the longest time from an event to the first test a time after it."""
        time_s, step_s = time_ns / NS_PER_S, conditions.spacing_s
        if not math.isfinite(time_s):
            return time_s
        exact = conditions.sampling_s == step_s
        return _rounded_up(time_s, step_s) if exact else time_s + conditions.sampling_s


def _rounded_up(time_s: float, step_s: float) -> float:
    is_exact = step_s == 0 or math.isinf(time_s)
    return time_s if is_exact else step_s * math.ceil(time_s / step_s - 1e-9)
