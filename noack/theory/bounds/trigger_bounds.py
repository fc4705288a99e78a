"""What a certificate uses of a trigger rule: bounds of e_s after tests, its growth, event times.

Every rule is data (:mod:`noack.trigger.trigger_rule`), so the bounds follow from its fields:

* a comparison bounds ‖e_s‖_W ≤ threshold + shares of x (:func:`comparison_bound`);
* one of the integral, ∫‖e_s‖_W ≤ δ, bounds ‖e_s‖_W ≤ δ/T at some time of the last T, for each T;
* until a dwell time has passed, and up to a deadline, e_s has grown from 0.

:class:`TriggerBounds` states these bounds. :class:`ErrorGrowth` is how e_s grows from them until
the next test, and :func:`first_passage_s` how long it takes from an event until it can reach a
level.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from noack.core.clock import NS_PER_S
from noack.core.linear_systems import Matrix, Vector
from noack.core.number_format import number
from noack.theory.bounds.certificate_terms import NetworkConditions, NoCertificateError, TriggerBound
from noack.theory.bounds.contraction import spectral_norm
from noack.theory.bounds.gains import Columns, Growth, Output, PlantGains
from noack.trigger.trigger_rule import QuadraticForm, TriggerRule

_ROUNDING = 1.0 + 1e-9
_RELATIVE, _RESIDUAL = 1e-7, 1e-13
"""Least eigenvalue of a positive definite Q₂₂, and the error of a computed Q, as shares of ‖Q‖."""


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
    holds with Girard's η, and where the threshold is what the state was at the last event.

    ``weight`` is W, (n, n). A rule that integrates compares ∫‖P z‖ instead of ‖P z‖.
    """
    if rule.from_event or rule.dynamic_variable is not None:
        return None
    n, (up, down) = len(weight), rule.form
    if not len(up):
        return None
    if up[:, :n].any() or down[:, n:].any():
        return _of_mixed_form(rule.form, weight)
    P, N = up[:, n:], down[:, :n]
    if np.array_equal(P, weight):
        return ComparisonBound(1.0, (N,) if N.any() else (), 1.0, bool(N.any()))
    if not _is_definite(P.T @ P, 1.0):
        return None
    size = float(np.linalg.norm(weight @ np.linalg.pinv(P), 2)) * _ROUNDING
    least = 1 / (float(np.linalg.norm(P @ np.linalg.inv(weight), 2)) * _ROUNDING)
    return ComparisonBound(size, (size * N,) if N.any() else (), least, bool(N.any()))


def _of_mixed_form(form: QuadraticForm, weight: Matrix) -> ComparisonBound | None:
    """Return the bound of a form that compares e_s together with x."""
    n = len(weight)
    Q = form.up.T @ form.up - form.down.T @ form.down
    size_of_Q = float(np.linalg.norm(form.up, 2) ** 2 + np.linalg.norm(form.down, 2) ** 2)
    if not _is_definite(Q[n:, n:], size_of_Q):
        return None
    J = np.linalg.solve(Q[n:, n:], Q[n:, :n])
    values, vectors = np.linalg.eigh(Q[:n, n:] @ J - Q[:n, :n])
    grown = values + _RESIDUAL / _RELATIVE * size_of_Q
    C = np.sqrt(grown[grown > 0])[:, None] * vectors.T[grown > 0]
    F = np.linalg.cholesky(Q[n:, n:]).T
    size = float(np.linalg.norm(weight @ np.linalg.inv(F), 2)) * _ROUNDING
    shares = (size * C, _ROUNDING * weight @ J)
    return ComparisonBound(size, tuple(S for S in shares if S.any()), 0.0, bool(C.any()))


def _is_definite(Q: Matrix, size: float) -> bool:
    """Return whether a symmetric Q is positive definite beyond rounding, (n, n)."""
    values = np.linalg.eigvalsh(Q)
    return bool(values[0] > _RELATIVE * max(size, float(values[-1])))


_AVERAGED = 2.0 ** np.arange(-6, 5)
"""Times over which an integral is averaged, in time constants of the model."""
_NONE = 'where the rule does not transmit, e_s may still have any size; combine it with policy = "deadline"'
_ACCUMULATE = (
    "events may accumulate, since no threshold keeps them apart; "
    'test the rule at sampling times, or combine it with policy = "dwell"'
)
COARSE_CELLS = 64
_FINE_CELLS = 256
_SHORTEST_S, LONGEST_S = 1e-9, 1e6
_PICARD_ROUNDS = 8


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
        """What follows from the comparison; None if nothing."""
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

    def tested(self, conditions: NetworkConditions) -> NetworkConditions:
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

    def bound(self, conditions: NetworkConditions, level: float, reached: float | None) -> TriggerBound:
        """Return all bounds; their unit is the level, or 1 without one.

        Args:
            conditions: as :meth:`tested` returns them.
            level: the largest threshold, scaled.
            reached: the smallest threshold; None if it may be arbitrarily small.

        Raises:
            NoCertificateError: nothing bounds e_s, or nothing separates events.
        """
        due_s, forced_s, apart_s = self._between_events(conditions)
        h_s = conditions.sampling_s
        idle_s = self._longest_until_test(self.rule.idle_ns, conditions)
        untested_s = max(idle_s - h_s, 0.0) if math.isfinite(idle_s) else 0.0
        bounds: list[TriggerBound] = []
        if self.comparison is not None:
            if reached is not None:
                reached = reached * self.comparison.least / self.comparison.size or None
            shares = {**dict.fromkeys(self.outputs, 1.0), **self._slope(level)}
            # Of the trapezoids of tests that may be missing, the oldest may count most.
            is_mean = self.area > 0 and h_s == conditions.spacing_s
            for ago_s, beta, least in self._levels(conditions, level, reached):
                root = next(iter(shares)) if self.comparison.has_root else ""
                bound = TriggerBound(beta, least, shares, untested_s, ago_s=ago_s, is_mean=is_mean, root=root)
                # What enters is followed if there is one growth; two growths are smaller.
                bounds += [bound._replace(is_one_growth=True), bound] if untested_s else [bound]
        if math.isfinite(due_s):
            bounds.append(TriggerBound(0.0, None, {}, due_s - h_s, is_tested=False))
        if not bounds:
            raise NoCertificateError(_NONE)
        is_separated = apart_s or conditions.spacing_s or any(bound.reached for bound in bounds)
        grows_first = level > 0 and self.comparison is not None and self.comparison.least > 0
        if not is_separated and not grows_first:
            raise NoCertificateError(_ACCUMULATE)
        if self.is_homogeneous:
            apart_s = max(apart_s, conditions.spacing_s)
        return bounds[0]._replace(
            unit=level or 1.0, apart_s=apart_s, due_s=due_s, forced_s=forced_s, also=tuple(bounds[1:])
        )

    def divided(
        self, conditions: NetworkConditions, apart_s: float
    ) -> list[tuple[TriggerBound, TriggerBound]]:
        """Return each bound without its constant, and with it, both in units of 1.

        Parts of the signals may be added only if they use the same bound. ``apart_s`` is a known
        lower bound of the inter-event time.

        Raises: as :meth:`bound`.
        """
        whole = self.bound(conditions, self.floor, self.floor or None)
        alone = [
            bound._replace(
                apart_s=apart_s, due_s=whole.due_s, forced_s=whole.forced_s, unit=1.0, reached=None, also=()
            )
            for bound in whole.every
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
        largest_norm = self.largest * float(spectral_norm(S @ np.linalg.inv(self.weight))) * _ROUNDING
        return {name: (math.hypot(level, largest_norm) - level) / largest_norm * _ROUNDING}

    def _levels(
        self, conditions: NetworkConditions, level: float, reached: float | None
    ) -> list[tuple[float, float, float | None]]:
        """Return (T, β, least ‖e_s‖_W at an event): ‖e_s‖_W ≤ β at some time of the last T."""
        if not self.area:
            return [(0.0, level, reached)]
        assert self.comparison is not None
        least = self.comparison.least * self.rule.floor
        test_s, longest_s = conditions.spacing_s, conditions.sampling_s
        times_s = _AVERAGED / self.fastest_per_s
        if test_s:  # the trapezoidal sum of the last k tests
            tests = sorted({math.ceil(t_s / test_s) for t_s in times_s})
            return [(k * longest_s, self.area / (k * test_s), least / (k * longest_s)) for k in tests]
        return [(t_s, self.area / t_s, least / t_s) for t_s in times_s.tolist()]

    def _between_events(self, conditions: NetworkConditions) -> tuple[float, float, float]:
        """Return times between two events, whatever e_s does.

        Returns:
            The longest; the shortest after which an event is due; the shortest.
        """
        rule = self.rule
        due_s = self._longest_until_test(rule.longest_ns, conditions)
        step_s = conditions.spacing_s
        apart_s = _rounded_up(rule.earliest_ns / NS_PER_S, step_s)
        forced_s = _rounded_up(rule.longest_ns / NS_PER_S, step_s)
        return due_s, forced_s, apart_s

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


class ErrorGrowth:
    """The growth of e_s without a test: from the bound after a test, or from 0 after an event.

    Then ‖e_s‖_W ≤ ``fixed`` + ``estimation`` η + Σ_C ``shares``_C sup‖C x‖ =: b. Until the next
    test, sup‖e_s‖_W ≤ ``stretch`` b + ``driven`` · (sup‖p‖, sup‖R_E x‖, 1).

    ``ages_s``: b bounds the mean of ‖e_s‖_W over the times so long ago; by default ``longest_s``.
    """

    def __init__(
        self, plant: PlantGains, longest_s: float, after: TriggerBound, ages_s: Vector | None = None
    ) -> None:
        outputs = plant.outputs
        self.ages_s = np.array([longest_s]) if ages_s is None else ages_s
        self.mean_s, self.highest = float(self.ages_s.mean()), np.zeros(())
        self.longest_s, self.stretch = longest_s, plant.error.stretch(longest_s)
        self.fixed, self.shares, self.root = after.beta, after.shares, after.root
        # The trigger tests x_s − x̂, and may compare it with x̂.
        self.estimation = 1 + sum(
            share * spectral_norm(outputs[C] @ plant.error.inverse_weight)
            for C, share in after.shares.items()
        )
        zero = np.zeros(())
        self.driven: tuple[Vector, Vector, Vector] = (zero, zero, zero)
        if longest_s > 0:
            growth = plant.growth(longest_s, COARSE_CELLS)
            self.driven, self.highest = growth.means(self.ages_s), growth.input_error.sup_on_grid()

    def after_test(self, states: Mapping[str, float]) -> float:
        """Return b, given bounds of sup‖C x‖; not linear in them."""
        shares = sum(share * states[C] for C, share in self.shares.items() if self.root != C)
        return math.hypot(self.fixed, states.get(self.root, 0.0)) + shares


def list_growths(plant: PlantGains, sampling_s: float, bound: TriggerBound) -> list[ErrorGrowth]:
    """Return how e_s grows after a test, and from 0 after an event, or one growth for both."""
    tested_s, untested_s = sampling_s + bound.ago_s, sampling_s + bound.untested_s
    if bound.is_one_growth:
        return [ErrorGrowth(plant, max(tested_s, untested_s), bound)]
    growths = []
    if bound.is_tested:
        growths.append(ErrorGrowth(plant, tested_s, bound, _mean_ages_s(bound, sampling_s)))
    if bound.untested_s > 0 or not bound.is_tested:
        growths.append(ErrorGrowth(plant, untested_s, TriggerBound(0.0, None)))
    return growths


def _mean_ages_s(bound: TriggerBound, sampling_s: float) -> Vector | None:
    """Return the ages of the e_s of which the bound is that of a mean, at most, if it is one."""
    if not (bound.is_mean and bound.ago_s):
        return None
    if sampling_s == 0:
        return bound.ago_s * np.arange(1, COARSE_CELLS + 1) / COARSE_CELLS
    # The trapezoid of the two tests i and i + 1 before the last one.
    tests = np.arange(1, round(bound.ago_s / sampling_s) + 1)
    return sampling_s * np.concatenate([tests, tests + 1])


def first_passage_s(
    plant: PlantGains, level: Vector, mismatch: Vector, input_error: Vector, error_gain: Vector, start: Vector
) -> Vector:
    """Return times before which ‖e_s‖_W, starting at ``start``, cannot reach ``level``, (…, loops).

    Let ρ(r) = sup_{s≤r} ‖e_s‖_W. The part of e_c that equals the present e_s is bounded by ρ:

        ρ(r) ≤ ∫₀^r ‖W e^{Hs} L_E‖ sup‖R_E x‖ + ‖W e^{Hs} B U‖ (π' + k · ρ(r−s)) ds

    and further terms from the disturbances and ``start``. This is iterated from ρ = ``level``;
    every iterate is a bound until the level is reached.

    Args:
        plant: one plant, or as many as there are values, (loops,).
        level: one ‖e_s‖_W or several of each loop, (…, loops).
        mismatch: sup‖R_E x‖, (loops,).
        input_error: π', the input error without the effect of the present e_s, (loops,).
        error_gain: k = ‖K W^{−1}‖, (loops,).
        start: ‖e_s‖_W at first, (loops,).
    """
    start_of_growth = plant.growth(_SHORTEST_S, 1)
    speed = start_of_growth.mismatch.sup_on_grid() * mismatch
    speed = speed + start_of_growth.input_error.sup_on_grid() * (input_error + error_gain * level)
    speed = speed + start_of_growth.forced.sum(axis=-1) / _SHORTEST_S
    # The first window is twice the time to the level at the initial speed, limited.
    window_s = np.where(speed > 0, 2 * level / np.where(speed > 0, speed, 1.0), LONGEST_S)
    window_s = window_s.clip(_SHORTEST_S, LONGEST_S)
    is_open, shape, loops = (level > start).ravel(), level.shape, level.shape[-1]
    level, window_s = level.ravel(), window_s.ravel()
    known_s, cells = np.zeros(level.size), np.full(level.size, COARSE_CELLS)
    while is_open.any():
        count = int(cells[is_open].min())
        places = np.flatnonzero(is_open & (cells == count))
        loop = places % loops
        columns = Columns(*(column[loop] if column.ndim == 3 else column for column in plant.columns))
        error = plant.error
        growth = error.growths(columns, window_s[places], count, error.stacked_norm)[Output.WEIGHTED]
        first_cells = _first_crossed(
            growth, level[places], mismatch[loop], input_error[loop], error_gain[loop],
            np.array([column and column * error.stretch(until_s) for column, until_s in zip(
                start[loop].tolist(), window_s[places].tolist(), strict=True
            )]),
        )  # fmt: skip
        for place, edge_s, cell in zip(places.tolist(), growth.mismatch.edges_s, first_cells, strict=True):
            if cell < count:
                known_s[place] = max(known_s[place], edge_s[cell])
                is_open[place] = count != _FINE_CELLS
                window_s[place], cells[place] = edge_s[cell + 1], _FINE_CELLS
            elif window_s[place] >= LONGEST_S:
                known_s[place], is_open[place] = window_s[place], False
            else:  # not reached, also after a coarse grid's overestimate: extend the window
                known_s[place], window_s[place] = window_s[place], 2 * window_s[place]
    return known_s.reshape(shape)


def _first_crossed(
    growth: Growth, level: Vector, mismatch: Vector, input_error: Vector, error_gain: Vector, started: Vector
) -> list[int]:
    """Return the first cell of each loop in which the level may be reached, or their number."""
    areas = growth.mismatch.area * mismatch[:, None]
    areas = areas + growth.input_error.area * input_error[:, None]
    fixed = np.cumsum(areas + growth.forced, axis=-1) + started[:, None]
    rho = np.repeat(level[:, None], fixed.shape[-1], axis=1)
    echoing = np.broadcast_to(growth.input_error.area, rho.shape)
    for _ in range(_PICARD_ROUNDS):
        echo = [np.convolve(area, r)[: len(r)] for area, r in zip(echoing, rho, strict=True)]
        before, rho = rho, np.minimum(level[:, None], fixed + error_gain[:, None] * np.array(echo))
        if np.array_equal(before, rho):
            break
    crossed = rho >= level[:, None]
    cells: list[int] = np.where(crossed.any(axis=1), crossed.argmax(axis=1), rho.shape[1]).tolist()
    return cells
