"""The inequalities (I1) of a certificate, solved for an assumed inter-event time.

Assumptions: the trigger ‖e_s‖_W > βe^{−αt} is tested at least every h seconds, the network keeps
its guarantee about losses, and the input is held. With all signals scaled by e^{αt}:

    sup‖C e_c‖  ≤ D_C β + I_C sup‖R_E x‖ + J_C π                              (I1)
    sup‖C x‖    ≤ free_C + gain_C (q + sup‖K e_c‖)                            (the plant)
    q           ≤ Σ_{C = σKH, ½σ²KH², r(σ)W} (sup‖C x‖ + sup‖C e_c‖)          (input of age ≤ σ)
    π = sup‖p‖  ≤ sup‖K e_c‖ + q
    β̃ = sup‖e_s‖_W ≤ ḡβ + I_E sup‖R_E x‖ + I_B π                              (between two tests)

with at most N missing events: the longest burst of losses, and ⌈d/δ⌉ in flight. Each e_s, now or at
an event, is what it was at the last test, at most β, and what has entered since, through L_E and
B U. Both parts are followed on their own, each with its direction:

    D_C = sup_{r≤h} ‖C e^{Gr} W⁻¹‖ + Σ_{j<N} sup_{τ≥jδ} ‖C e^{Gτ} W⁻¹‖,       G = H + αI
    J_C = ∫₀^h ‖C e^{Gr} B U‖ dr + Σ_{j<N} min(h sup_{τ≥jδ} ‖C e^{Gτ} B U‖, I_B sup ‖C e^{Gτ} W⁻¹‖)

and I_C the same with L_E. A policy's threshold may contain more than β
(:mod:`noack.theory.bounds.trigger_bounds`); where e_s may have grown in several ways, β̃ is used in
place of β, without I_C and J_C. These inequalities are linear and hold on every [0, T]. So their
solution bounds the run if the loop gain is below 1.

**Solution.** For v ≤ F v + g with F, g ≥ 0: if some w > 0 has F w < w, the spectral radius of F is
below 1, and v ≤ x for every x with x − F x ≥ g. Both are checked with a bound of all rounding, so
nothing depends on how w and x were computed. x begins as the computed (I − F)⁻¹ g. Where x − F x
misses g by r, adding w max r/(w − F w) is enough.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.cached_method import cached_method
from noack.core.linear_systems import Matrix, Vector
from noack.theory.bounds.certificate_terms import CertificatePart, Constants, NetworkConditions
from noack.theory.bounds.error_growth import ErrorGrowth, first_passage_s, list_growths
from noack.theory.bounds.gains import Coefficients, Counts, Output
from noack.theory.certificates.error_rows import (
    UNIT_ROWS,
    BoundMethod,
    ErrorRows,
    Signal,
    SignalRows,
    columns,
    signal_row,
)

MOST_MISSING = 1000
"""No bounds are computed for more missing events at once: the work grows with their number."""
_EPSILON = float(np.finfo(float).eps)
"""The relative distance of two neighbouring doubles: twice the error of an operation."""


class Solution(NamedTuple):
    """The bound of v, of one loop or of several."""

    loop_gain: Vector
    """(…) 1 minus the smallest leading principal minor of I − F; below 1 if and only if ρ(F) < 1.
    If it is not below 1: at least the largest entry of the diagonal."""
    bound: Vector
    """(…, k) upper bound of v; infinite where ρ(F) < 1 was not confirmed."""
    failing: Counts
    """(…) The first signal with which no bound follows from those before it: that of the first
    leading principal minor not above 0. Of no use where ρ(F) < 1."""


def solve_inequalities(F: Matrix, g: Vector) -> Solution:
    """Return the smallest bound of v that follows, for F of shape (…, k, k) and g of (…, k)."""
    size = F.shape[-1]
    # A signal that is 0 affects nothing.
    F = np.where((F.any(axis=-1) | (g > 0))[..., None, :], F, 0.0)
    # A right side of the size of x makes w/x dimensionless.
    scales = g + _apply(F, g + _apply(F, g))
    least = np.where(scales > 0, scales, np.inf).min(axis=-1, keepdims=True)
    right = np.where(scales > 0, scales, np.where(np.isfinite(least), least, 1.0))
    remainder = np.eye(size) - F
    minor, x, w = _eliminate(remainder, g, right)
    loop_gain = np.asarray(1 - minor)
    is_small, failing = loop_gain < 1, np.zeros(minor.shape, dtype=np.int64)
    if not is_small.all():  # the elimination ends too early there
        large = ~is_small
        with np.errstate(invalid="ignore"):
            minors = [np.linalg.det(remainder[large][..., :k, :k]) for k in range(1, size + 1)]
        failing[large] = (np.stack(minors, axis=-1) <= 0).argmax(axis=-1)
        diagonal = np.diagonal(F[large], axis1=-2, axis2=-1)
        gains = np.concatenate([1 - np.min(minors, axis=0)[..., None], diagonal], axis=-1)
        is_finite = np.isfinite(gains).all(axis=-1)
        loop_gain[large] = np.where(is_finite, np.maximum(gains.max(axis=-1), 1.0), np.inf)
    # F w < w is confirmed with all rounding, and x is raised until x − F x ≥ g.
    rounding = (size + 4) * _EPSILON
    F_x, F_w = _apply(F, x), _apply(F, w)
    slack = w - F_w - rounding * (w + F_w)
    shortfall = F_x + g - x + rounding * (F_x + g + x)
    largest = np.maximum((shortfall / slack).max(axis=-1, keepdims=True), 0.0)
    bound = np.where(F.any(axis=-1), x + w * largest * (1 + rounding), g)
    confirmed = is_small & (w > 0).all(axis=-1) & (slack > 0).all(axis=-1)
    return Solution(loop_gain, np.where(confirmed[..., None], bound, np.inf), failing)


def _apply(F: Matrix, v: Vector) -> Vector:
    return np.asarray((F @ v[..., None])[..., 0])


def _eliminate(matrix: Matrix, *right_sides: Vector) -> tuple[Vector, ...]:
    """Return the smallest leading principal minor, (…), and the solutions, (…, k).

    Minors after the first one not above 0 are left out; the solutions are then of no use. The
    elimination is that of Gauss without exchanges.
    """
    size = matrix.shape[-1]
    rows = np.concatenate([matrix, np.stack(right_sides, axis=-1)], axis=-1)
    minor = np.ones(matrix.shape[:-2])
    smallest, counts = np.full_like(minor, np.inf), np.ones_like(minor, dtype=bool)
    for k in range(size):
        minor = minor * rows[..., k, k]
        smallest = np.where(counts, np.minimum(smallest, minor), smallest)
        counts = counts & (minor > 0)
        rows[..., k, :] /= rows[..., k, k, None].copy()
        shares = rows[..., k].copy()
        shares[..., k] = 0.0
        rows -= np.where(shares != 0, shares, 0.0)[..., None] * rows[..., k : k + 1, :]
    return smallest, *np.moveaxis(rows[..., size:], -1, 0)


class LoopConstants(NamedTuple):
    """The constants of several loops but δ, (loops,) each: see ``Constants`` in ``certificate_terms``."""

    missing_events: Counts
    delta: Vector
    overshoot: Vector
    input_error: Vector
    start_error: Vector
    state: Vector
    state_weighted: Vector
    mismatch: Vector
    loop_gain: Vector
    estimation_error: Vector
    received_input_error: Vector
    earlier_input_error: Vector
    """The part of the input error that does not come from the present e_s."""
    failing: Counts
    """The first signal without a bound, where there is no certificate: see :class:`Solution`."""
    exists: NDArray[np.bool_]
    """Where there is a certificate; of the others only ``loop_gain`` and ``failing`` are of use."""

    def of_loop(self, loop: int, rate_per_s: float, inter_event_s: float | None) -> Constants:
        """Return the constants of one loop."""
        fields = {name: values[loop].item() for name, values in self._asdict().items()}
        del fields["exists"], fields["failing"], fields["earlier_input_error"]
        fields["present_input_error"] = fields["received_input_error"]
        return Constants(rate_per_s=rate_per_s, inter_event_s=inter_event_s, **fields)


def _without_bounds(events: Counts) -> LoopConstants:
    """Return that loops have no certificate, because their missing events are too many."""
    infinite = np.full(len(events), np.inf)
    names = [name for name in LoopConstants._fields if name not in ("missing_events", "failing", "exists")]
    others = dict.fromkeys(names, infinite)
    return LoopConstants(missing_events=events, failing=0 * events, exists=infinite < 0, **others)


class ErrorInequalities:
    """The inequalities of one part, and their solution for assumed inter-event times.

    The part is that of one loop, or of several (:meth:`PlantGains.together`), with the same
    trigger and conditions; inter-event times and solutions are those of each loop.
    """

    def __init__(self, part: CertificatePart, conditions: NetworkConditions, earlier_error: float) -> None:
        self._error, self._plant, self._bound, self._estimation = error, plant, bound, _ = part
        self._conditions = conditions
        self.age_gains = error.age_gains(conditions.hold_s)
        self._start_error, start = plant.start_up(conditions.start_s)
        self._first_input_error = np.maximum(self._start_error, earlier_error)
        self._states = {
            output: Coefficients(free + start[output], gain) for output, (free, gain) in plant.states.items()
        }
        self._growths = [
            list_growths(plant, conditions.sampling_s, part_bound) for part_bound in bound.all_bounds
        ]
        self._begin_s = math.inf if earlier_error else conditions.start_s
        self._error_rows = ErrorRows(part, conditions, self._first_input_error, self._begin_s)

    @property
    def methods(self) -> Sequence[BoundMethod]:
        """The methods by which e_c can be bounded; the first one is usually the tighter one."""
        if self._conditions.delay_s > 0 and self._error.decays:
            return [BoundMethod.DRIFTING, BoundMethod.MISSING]
        return [BoundMethod.MISSING]

    @cached_method
    def constants(self, inter_event_s: Vector, method: BoundMethod) -> LoopConstants:
        """Return all constants but δ, given inter-event times of at least ``inter_event_s``, (loops,).

        A loop without a certificate has a loop gain that is not below 1, and perhaps infinite.
        """
        conditions = self._conditions
        events = np.full(len(inter_event_s), conditions.dropouts)
        is_spaced = inter_event_s > 0
        if conditions.delay_s > 0:  # of arbitrarily close events, any number of updates may be in flight
            events[is_spaced] += np.ceil(conditions.delay_s / inter_event_s[is_spaced]).astype(np.int64)
        is_counted = (is_spaced | (conditions.delay_s == 0)) & (events <= MOST_MISSING)
        if not is_counted.any():
            return _without_bounds(events)
        solved = self._solutions(method, np.where(is_counted, events, conditions.dropouts), inter_event_s)
        smallest = np.min([solution.bound for _, solution in solved], axis=0)
        gains = np.array([solution.loop_gain for _, solution in solved])
        gain = np.where(is_counted, gains.min(axis=0), np.inf)
        failing = _taken([solution.failing for _, solution in solved], gains.argmin(axis=0))
        by_bound = []
        for signals, solution in solved:  # b differs from bound to bound
            bound = np.where(UNIT_ROWS[Signal.AFTER_TEST] == 1, solution.bound, smallest)
            implied = self._implied_bounds(signals, events, gain, bound, is_counted)
            by_bound.append(implied._replace(failing=failing))
        exists = np.any([constants.exists for constants in by_bound], axis=0)
        return LoopConstants(*map(np.fmin.reduce, zip(*by_bound, strict=True)))._replace(exists=exists)

    def _solutions(
        self, method: BoundMethod, events: Counts, inter_event_s: Vector
    ) -> list[tuple[SignalRows, Solution]]:
        """Return the signals, and what bounds them all, for each bound of e_s."""
        solved = []
        for growths in self._growths:  # all bounds of e_s hold; of each, one growth applies
            own_growth = growths[0] if len(growths) == 1 and self._error.decays else None
            signals = self._error_rows.signals(method, events, inter_event_s, own_growth)
            solutions = [self._solve_for_growth(signals, growth, own_growth) for growth in growths]
            gains = np.array([solution.loop_gain for solution in solutions])
            failing = _taken([solution.failing for solution in solutions], gains.argmax(axis=0))
            bound = np.max([solution.bound for solution in solutions], axis=0)
            solved.append((signals, Solution(gains.max(axis=0), bound, failing)))
        return solved

    def _implied_bounds(
        self,
        signals: SignalRows,
        events: Counts,
        loop_gain: Vector,
        solved: Matrix,
        is_counted: NDArray[np.bool_],
    ) -> LoopConstants:
        """Return what follows from bounds of v, (loops, 6)."""
        age_input, estimation = solved[..., Signal.AGE_INPUT], solved[..., Signal.ESTIMATION_ERROR]
        input_error = _product(signals.input_error, solved)
        state = {C: free + gain * input_error for C, (free, gain) in self._states.items()}
        constants = LoopConstants(
            missing_events=events,
            delta=(_product(signals.errors[Output.WEIGHTED], solved) + estimation) / self.unit,
            overshoot=(_product(signals.sensor, solved) + estimation) / self.unit,
            input_error=input_error,
            start_error=self._start_error,
            state=state[Output.STATE],
            state_weighted=state[Output.WEIGHTED],
            mismatch=state[Output.MISMATCH],
            loop_gain=loop_gain,
            estimation_error=estimation,
            received_input_error=_product(signals.received, solved) + age_input,
            earlier_input_error=_product(signals.earlier, solved) + age_input,
            failing=0 * events,
            exists=np.isfinite(solved).all(axis=-1) & is_counted,
        )
        return LoopConstants._make(np.broadcast_to(values, events.shape) for values in constants)

    @property
    def unit(self) -> float:
        """The unit of Δ and β̃/β."""
        return self._bound.beta if self._bound.unit is None else self._bound.unit

    def _by_state(self, signals: SignalRows, shares: Mapping[str, Vector | float]) -> tuple[Matrix, Vector]:
        """Return Σ_C share_C sup‖C x‖ as a row of the signals, (…, 6), and a constant, (…)."""
        free, gain = np.zeros(()), np.zeros(())
        for C, share in shares.items():
            free = free + share * self._states[C].free
            gain = gain + share * self._states[C].gain
        return gain[..., None] * signals.input_error, free

    def _solve_for_growth(
        self, signals: SignalRows, growth: ErrorGrowth, own_growth: ErrorGrowth | None
    ) -> Solution:
        """Return the loop gains, (loops,), and the bounds of the signals, (loops, 6).

        The inequality of each signal is a row of the signals and a constant.
        """
        input_error, estimation = signals.input_error, self._estimation
        row, constant = self._by_state(signals, {str(C): gain for C, gain in self.age_gains.items()})
        by_errors = sum(gain * signals.errors[output] for output, gain in self.age_gains.items())
        age_input = (row + by_errors, constant)
        row, constant = self._by_state(signals, estimation.shares)
        estimation_error = (
            row + estimation.from_input * input_error,
            estimation.fixed + constant + estimation.from_input * self._first_input_error,
        )
        mismatch = self._by_state(signals, {Output.MISMATCH: 1.0})
        row, constant = self._by_state(signals, growth.shares)
        after_test = (row + growth.estimation * UNIT_ROWS[Signal.ESTIMATION_ERROR], growth.fixed + constant)
        if own_growth is None:
            driven = self._error_rows.with_start(signal_row(0.0, 0.0, growth.driven), growth.highest)
            after_test = growth.stretch * after_test[0] + driven, growth.stretch * after_test[1]
        inequalities = {
            Signal.AGE_INPUT: age_input,
            Signal.AFTER_TEST: after_test,
            Signal.ESTIMATION_ERROR: estimation_error,
            Signal.INPUT_ERROR: (input_error, 0.0),
            Signal.MISMATCH: mismatch,
            Signal.ONE: (0.0 * input_error, 1.0),
        }
        rows = _rows(*(inequalities[signal][0] for signal in Signal))
        right = columns(*(inequalities[signal][1] for signal in Signal))
        return solve_inequalities(rows, np.broadcast_to(right, rows.shape[:-1]))

    def inter_event_s(
        self,
        *,
        mismatch: Vector,
        earlier_input_error: Vector,
        estimation_error: Vector,
        drifts: NDArray[np.bool_],
        searched: NDArray[np.bool_],
    ) -> Vector:
        """Return the times that ‖e_s‖_W needs to the next event, (loops,).

        Args:
            mismatch: bounds of ‖E x‖_W until then, (loops,).
            earlier_input_error: those of the input error without the part of the present e_s.
            estimation_error: those of ‖x̂ − x‖_W at the measurements.
            drifts: where the method is ``DRIFTING``, (loops,).
            searched: the loops whose times are needed, (loops,); the others are of no use.
        """
        # The part of D_K that is the e_s of now.
        error_gain = np.where(drifts, 0.0, self._error.now(Output.GAIN))
        input_error = np.maximum(earlier_input_error, self._first_input_error)
        estimation = np.where(searched, estimation_error, 0.0)
        # After an event e_s is the estimation error, and x_s − x̂ differs from e_s by one, too.
        levels_and_times = [
            (bound.least_event_error, bound.window_s or math.inf)
            for bound in self._bound.all_bounds
            if bound.least_event_error is not None
        ]
        levels, most_s = (np.array(values)[:, None] for values in zip(*levels_and_times, strict=True))
        passed_s = first_passage_s(
            self._plant,
            level=np.where(searched, levels - estimation, 0.0),
            mismatch=np.where(searched, mismatch, 0.0),
            input_error=np.where(searched, input_error, 0.0),
            error_gain=error_gain,
            start=estimation,
        )
        next_event_s = np.minimum(passed_s, most_s).max(axis=0)
        times = self._bound.times
        next_event_s = np.maximum(np.minimum(next_event_s, times.earliest_due_s), times.shortest_s)
        if (grid_s := self._conditions.spacing_s) == 0:
            return np.asarray(next_event_s)
        return np.asarray(grid_s * np.maximum(np.ceil(next_event_s / grid_s - 1e-9), 1.0))


def _taken(values: Sequence[Counts], index: Counts) -> Counts:
    """Return of several values of each loop, (loops,) each, that of an index, (loops,)."""
    return np.asarray(np.take_along_axis(np.stack(values), index[None], axis=0)[0])


def _product(row: Vector, column: Vector) -> Vector:
    """Return the scalar products of vectors, (…, k)."""
    return np.asarray((row[..., None, :] @ column[..., None])[..., 0, 0])


def _rows(*values: Vector) -> Matrix:
    """Return vectors of loops, (…, j), one below the other, (…, k, j)."""
    *lead, size = np.broadcast(*values).shape
    rows = np.empty((*lead, len(values), size))
    for index, value in enumerate(values):
        rows[..., index, :] = value
    return rows
