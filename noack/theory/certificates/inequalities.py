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
from enum import Enum, IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.cached_method import cached_method
from noack.core.linear_systems import Matrix, Vector
from noack.theory.bounds.certificate_terms import CertificatePart, Constants, NetworkConditions
from noack.theory.bounds.error_growth import COARSE_CELLS, ErrorGrowth, first_passage_s, list_growths
from noack.theory.bounds.gains import Coefficients, Counts, Output, sum_of_sups


class Signal(IntEnum):
    """The entries of v, in their order in all rows and columns."""

    AGE_INPUT = 0
    """q, the part of the input that its age adds."""
    AFTER_TEST = 1
    """b, the bound of ‖e_s‖_W after each test, or β̃."""
    ESTIMATION_ERROR = 2
    """η = sup‖x̂ − x‖_W."""
    INPUT_ERROR = 3
    """π."""
    MISMATCH = 4
    """sup‖R_E x‖."""
    ONE = 5
    """The constant 1."""


_UNIT = np.eye(len(Signal))
"""For each signal the row that selects it."""
MOST_STAGES = 16
"""With more missing events π is used for all of them."""
_EPSILON = float(np.finfo(float).eps)
"""The relative distance of two neighbouring doubles: twice the error of an operation."""


class Solution(NamedTuple):
    """The bound of v, of one loop or of several."""

    loop_gain: Vector
    """(…) 1 minus the smallest leading principal minor of I − F; below 1 if and only if ρ(F) < 1.
    If it is not below 1: at least the largest entry of the diagonal."""
    bound: Vector
    """(…, k) upper bound of v; infinite where ρ(F) < 1 was not confirmed."""


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
    is_small = loop_gain < 1
    if not is_small.all():  # the elimination ends too early there
        large = ~is_small
        with np.errstate(invalid="ignore"):
            minors = [np.linalg.det(remainder[large][..., :k, :k]) for k in range(1, size + 1)]
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
    return Solution(loop_gain, np.where(confirmed[..., None], bound, np.inf))


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


class BoundMethod(Enum):
    """The ways to bound e_c. Bounds of parts may be added only if they use the same method."""

    MISSING = "by e_s and by the errors of all missing events"
    DRIFTING = "by its value d ago, and by what has driven it since"


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
    exists: NDArray[np.bool_]
    """Where there is a certificate; of the others only ``loop_gain`` is of use."""

    def of_loop(self, loop: int, rate_per_s: float, inter_event_s: float | None) -> Constants:
        """Return the constants of one loop."""
        fields = {name: values[loop].item() for name, values in self._asdict().items()}
        del fields["exists"], fields["earlier_input_error"]
        fields["present_input_error"] = fields["received_input_error"]
        return Constants(rate_per_s=rate_per_s, inter_event_s=inter_event_s, **fields)


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
        is_counted = is_spaced | (conditions.delay_s == 0)
        solved = self._solutions(method, events, inter_event_s)
        smallest = np.min([bound for _, _, bound in solved], axis=0)
        gain = np.where(is_counted, np.min([gain for _, gain, _ in solved], axis=0), np.inf)
        by_bound = []
        for signals, _, bound in solved:  # b differs from bound to bound
            bound = np.where(_UNIT[Signal.AFTER_TEST] == 1, bound, smallest)
            by_bound.append(self._implied_bounds(signals, events, gain, bound, is_counted))
        exists = np.any([constants.exists for constants in by_bound], axis=0)
        return LoopConstants(*map(np.fmin.reduce, zip(*by_bound, strict=True)))._replace(exists=exists)

    def _solutions(
        self, method: BoundMethod, events: Counts, inter_event_s: Vector
    ) -> "list[tuple[_Signals, Vector, Matrix]]":
        """Return the signals, the loop gains and the bounds of all signals for each bound of e_s."""
        solved = []
        for growths in self._growths:  # all bounds of e_s hold; of each, one growth applies
            own_growth = growths[0] if len(growths) == 1 and self._error.decays else None
            signals = self._signals(method, events, inter_event_s, own_growth)
            solutions = [self._solve_for_growth(signals, growth, own_growth) for growth in growths]
            gain = np.max([solution.loop_gain for solution in solutions], axis=0)
            solved.append((signals, gain, np.max([solution.bound for solution in solutions], axis=0)))
        return solved

    def _implied_bounds(
        self,
        signals: "_Signals",
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
            exists=np.isfinite(solved).all(axis=-1) & is_counted,
        )
        return LoopConstants._make(np.broadcast_to(values, events.shape) for values in constants)

    @property
    def unit(self) -> float:
        """The unit of Δ and β̃/β."""
        return self._bound.beta if self._bound.unit is None else self._bound.unit

    def _signals(
        self, method: BoundMethod, events: Counts, inter_event_s: Vector, own_growth: ErrorGrowth | None
    ) -> "_Signals":
        """Return how all outputs depend on v.

        Every ‖e_s‖_W has grown by ``own_growth`` from at most b at the last test; without it b is β̃. An
        event's x_s − x̂ is at most this plus η, the present x_s − x is at most this.
        """
        sensor = _UNIT[Signal.AFTER_TEST]
        if own_growth is not None:
            sensor = self._with_start(
                _signal_row(own_growth.stretch, 0.0, own_growth.driven), own_growth.highest
            )
        counted = events
        at_present = present = {output: self._present(output, own_growth) for output in self._error.outputs}
        if drifts := method is BoundMethod.DRIFTING:
            # d ago, e_c consisted of e_s and of the errors of events that are lost.
            counted = np.full_like(events, self._conditions.dropouts)
            present = {
                output: self._present(output, own_growth, self._conditions.delay_s) for output in at_present
            }

        def with_missing(
            output: Output, present: Matrix, count: Counts, stages: _Stages | None = None
        ) -> Matrix:
            return self._with_missing(output, present, count, inter_event_s, own_growth, stages)

        stages = self._stages(present[Output.GAIN], counted, inter_event_s, own_growth)
        errors = {output: with_missing(output, row, counted, stages) for output, row in present.items()}
        input_error = errors[Output.GAIN]
        earlier = input_error if drifts else with_missing(Output.GAIN, np.zeros(len(Signal)), counted, stages)
        received = with_missing(Output.GAIN, at_present[Output.GAIN], 0 * events)
        return _Signals(errors, sensor, received, earlier)

    def _by_state(self, signals: "_Signals", shares: Mapping[str, Vector | float]) -> tuple[Matrix, Vector]:
        """Return Σ_C share_C sup‖C x‖ as a row of the signals, (…, 6), and a constant, (…)."""
        free, gain = np.zeros(()), np.zeros(())
        for C, share in shares.items():
            free = free + share * self._states[C].free
            gain = gain + share * self._states[C].gain
        return gain[..., None] * signals.input_error, free

    def _present(self, output: Output, own_growth: ErrorGrowth | None, later_s: float = 0.0) -> Matrix:
        """Return the bound of sup‖C e_s‖ as a row of the signals.

        It is that of what e_s becomes, if nothing resets it, up to ``later_s`` after.
        """
        until_s, zero = later_s + (0.0 if own_growth is None else own_growth.longest_s), np.zeros(())
        driven: tuple[Vector, Vector, Vector] = (zero, zero, zero)
        if until_s > 0:
            growth = self._plant.growths(until_s, COARSE_CELLS)[output]
            driven = growth.totals if own_growth is None else growth.means(own_growth.ages_s + later_s)
        return _signal_row(self._error.now_until(until_s)[output], 0.0, driven)

    def _with_missing(
        self,
        output: Output,
        present: Matrix,
        events: Counts,
        inter_event_s: Vector,
        own_growth: ErrorGrowth | None,
        stages: "_Stages | None" = None,
    ) -> Matrix:
        """Return the bound of sup‖C e_c‖ as a row of the signals, given that of e_s, ``present``.

        The part of e_s that has grown since the last test is followed from where it entered.
        """
        gain = self._missing_gain(output, events, inter_event_s)
        driven: list[Vector | float] = (
            [0.0] * 3 if own_growth is None else [gain * size for size in own_growth.driven]
        )
        if own_growth is not None and own_growth.longest_s > 0:
            for index, kernel in enumerate(self._plant.driven[output]):
                followed = own_growth.mean_s * sum_of_sups(kernel, events, inter_event_s)
                driven[index] = np.minimum(driven[index], followed)
        highest = self._plant.driven[output][0].sup() if self._error.decays else 0.0
        row = self._with_start(present + _signal_row(gain, gain, driven), highest)
        if stages is not None and own_growth is not None:
            row[..., Signal.INPUT_ERROR] = present[..., Signal.INPUT_ERROR]
            row += stages.entered(
                *self._input_effects(output, len(stages.inputs), inter_event_s, own_growth), events
            )
        return row

    def _with_start(self, row: Matrix, highest: Vector | float) -> Matrix:
        """Add what enters before the first input, where ‖p‖ is not bounded by π.

        ``highest`` bounds what a p of 1 adds in a unit of time.
        """
        by_first_input = np.fmin(row[..., Signal.INPUT_ERROR], self._begin_s * highest)
        return np.asarray(row + (self._first_input_error * by_first_input)[..., None] * _UNIT[Signal.ONE])

    def _input_effects(
        self, output: Output, count: int, inter_event_s: Vector, own_growth: ErrorGrowth
    ) -> tuple[Matrix, Matrix]:
        """Bound how inputs before missing events move C e_c, from the newest event on.

        Returns:
            Of the inputs since the test before the event, for ‖p‖ ≤ 1, and of those of one second,
            (count, loops) each.
        """
        ages_s = inter_event_s[:, None] * np.arange(count)
        sups = np.broadcast_to(self._plant.driven[output][0].sups(ages_s), ages_s.shape).T
        gains = self._error.kernels[output].sups(ages_s).T
        return np.minimum(gains * own_growth.driven[0], own_growth.mean_s * sups), sups

    def _stages(
        self, present: Matrix, events: Counts, inter_event_s: Vector, own_growth: ErrorGrowth | None
    ) -> "_Stages | None":
        """Bound ‖p‖ while at most 0, 1, … events are missing; None where π is used instead.

        p since the test before a missing event was caused by fewer missing events, except before an
        update that was received has taken effect. ``present`` is the part of sup‖K e_c‖ that is not
        from missing events.
        """
        count, delay_s = int(events.max(initial=0)), self._conditions.delay_s
        if (
            own_growth is None
            or own_growth.longest_s == 0
            or not 0 < count <= MOST_STAGES
            or not inter_event_s.all()
        ):
            return None
        # p of each stage: a row of the signals.
        sizes, sups = self._input_effects(Output.GAIN, count, inter_event_s, own_growth)
        shape = len(inter_event_s), len(Signal)
        late_s = (delay_s - np.arange(count)[:, None] * inter_event_s).clip(0.0, own_growth.longest_s)
        counts = np.arange(count)[:, None] + np.zeros_like(events)
        rows = self._with_missing(Output.GAIN, present, counts, inter_event_s, own_growth)
        rows += _UNIT[Signal.AGE_INPUT]
        # The share of π from updates that act late.
        highest = float(np.max(self._plant.driven[Output.GAIN][0].sup()))
        by_input = present[..., Signal.INPUT_ERROR]
        input_before_update = np.minimum(by_input, highest * (delay_s - counts * inter_event_s).clip(min=0.0))
        rows[..., Signal.INPUT_ERROR] = input_before_update
        shares_left = 1 - (by_input - input_before_update)[..., None]
        # Stage by stage; π where its own share is 1 or more.
        stages = _Stages(np.zeros((0, *shape)), late_s)
        for row, share_left, number in zip(rows, shares_left, counts, strict=True):
            row = row + stages.entered(sizes, sups, number)
            solved = row / np.where(share_left > 0, share_left, 1.0)
            row = np.where(share_left > 0, solved, _UNIT[Signal.INPUT_ERROR])
            stages = stages._replace(inputs=np.concatenate([stages.inputs, row[None]]))
        return stages

    def _solve_for_growth(
        self, signals: "_Signals", growth: ErrorGrowth, own_growth: ErrorGrowth | None
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
        after_test = (row + growth.estimation * _UNIT[Signal.ESTIMATION_ERROR], growth.fixed + constant)
        if own_growth is None:
            driven = self._with_start(_signal_row(0.0, 0.0, growth.driven), growth.highest)
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
        right = _columns(*(inequalities[signal][1] for signal in Signal))
        return solve_inequalities(rows, np.broadcast_to(right, rows.shape[:-1]))

    def _missing_gain(self, output: Output, events: Counts, inter_event_s: Vector) -> Vector:
        if self._error.decays or math.isinf(self._bound.times.longest_s):
            return self._error.missing(output, events, inter_event_s)
        return self._error.missing_until(output, events, self._bound.times.longest_s)

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


class _Stages(NamedTuple):
    """Bounds of ‖p‖ while few events are missing."""

    inputs: Matrix
    """Rows of the signals, while 0, 1, … events are missing, (count, loops, 6)."""
    late_s: Matrix
    """For how long after the test before the first, second, … missing event an earlier update may
    not have taken effect yet, (count, loops)."""

    def entered(self, sizes: Matrix, sups: Matrix, events: Counts) -> Matrix:
        """Bound what has entered e_c before up to ``events`` missing events, (loops, 6).

        ``sizes`` and ``sups`` are those of :meth:`ErrorInequalities._input_effects`.
        """
        largest = np.zeros(self.inputs.shape[1:])
        for count in range(1, len(self.inputs) + 1):
            late = np.minimum(sizes[:count], self.late_s[count - 1 :: -1] * sups[:count])
            row = np.einsum("kl,klj->lj", sizes[:count] - late, self.inputs[count - 1 :: -1])
            row[:, Signal.INPUT_ERROR] += late.sum(axis=0)
            largest = np.where((count <= events)[:, None], np.maximum(largest, row), largest)
        return largest


class _Signals(NamedTuple):
    """The errors as linear functions of the signals: rows, (…, 6)."""

    errors: Mapping[Output, Vector]
    """Of sup‖C e_c‖."""
    sensor: Vector
    """Of β̃ = sup‖e_s‖_W."""
    received: Vector
    """Of sup‖K e_c‖ while no event is missing."""
    earlier: Vector
    """Of the part of sup‖K e_c‖ that does not come from the present e_s."""

    @property
    def input_error(self) -> Vector:
        """Of π."""
        return np.asarray(self.errors[Output.GAIN] + _UNIT[Signal.AGE_INPUT])


def _product(row: Vector, column: Vector) -> Vector:
    """Return the scalar products of vectors, (…, k)."""
    return np.asarray((row[..., None, :] @ column[..., None])[..., 0, 0])


def _signal_row(
    after_test: Vector | float, estimation_error: Vector | float, driven: Sequence[Vector | float]
) -> Matrix:
    """Return a row of the signals; ``driven`` has the entries of π, sup‖R_E x‖ and 1."""
    return _columns(0.0, after_test, estimation_error, *driven)


def _columns(*values: Vector | float) -> Matrix:
    """Return values of loops, (…), side by side, (…, k)."""
    columns = np.empty((*np.broadcast(*values).shape, len(values)))
    for index, value in enumerate(values):
        columns[..., index] = value
    return columns


def _rows(*values: Vector) -> Matrix:
    """Return vectors of loops, (…, j), one below the other, (…, k, j)."""
    *lead, size = np.broadcast(*values).shape
    rows = np.empty((*lead, len(values), size))
    for index, value in enumerate(values):
        rows[..., index, :] = value
    return rows
