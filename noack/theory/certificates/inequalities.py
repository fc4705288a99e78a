"""The inequalities (I1) of a certificate, solved for an assumed spacing of events.

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
place of β, without I_C and J_C. The part of x from lost events is smaller if few updates may be
lost in a window (:mod:`noack.theory.certificates.loss_accumulation`). These inequalities are linear
and hold on every [0, T]. So their solution bounds the run if the loop gain is below 1.

**Solution.** For v ≤ F v + g with F, g ≥ 0: if some w > 0 has F w < w, the spectral radius of F is
below 1, and v ≤ x for every x with x − F x ≥ g. Both are checked with a bound of all rounding, so
nothing depends on how w and x were computed. x begins as the computed (I − F)⁻¹ g. Where x − F x
misses g by r, adding w max r/(w − F w) is enough.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.cached_method import cached_method
from noack.core.linear_systems import Matrix, Vector
from noack.theory.bounds.gains import Coefficients, Counts, Output, sum_of_sups
from noack.theory.bounds.terms import Constants, NetworkConditions, Part
from noack.theory.bounds.trigger_bounds import COARSE_CELLS, ErrorGrowth, first_passage_s, list_growths
from noack.theory.certificates.loss_accumulation import LossAccumulation

_SIGNALS, _BEGUN, _LATER = 7, 3, 6
"""Number of the signals; places of π̄ and π, those of ‖p‖ with the start and without."""
_EPSILON = float(np.finfo(float).eps)


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
    sizes = g + _applied(F, g + _applied(F, g))
    least = np.where(sizes > 0, sizes, np.inf).min(axis=-1, keepdims=True)
    right = np.where(sizes > 0, sizes, np.where(np.isfinite(least), least, 1.0))
    remainder = np.eye(size) - F
    minor, x, w = _eliminated(remainder, g, right)
    loop_gain = np.asarray(1 - minor)
    is_small = loop_gain < 1
    if not is_small.all():
        large = ~is_small
        with np.errstate(invalid="ignore"):
            minors = [np.linalg.det(remainder[large][..., :k, :k]) for k in range(1, size + 1)]
        diagonal = np.diagonal(F[large], axis1=-2, axis2=-1)
        gains = np.concatenate([1 - np.min(minors, axis=0)[..., None], diagonal], axis=-1)
        known = np.isfinite(gains).all(axis=-1)
        loop_gain[large] = np.where(known, np.maximum(gains.max(axis=-1), 1.0), np.inf)
    rounding = (size + 4) * _EPSILON
    moved_x, moved_w = _applied(F, x), _applied(F, w)
    slack = w - moved_w - rounding * (w + moved_w)
    missing = moved_x + g - x + rounding * (moved_x + g + x)
    largest = np.maximum((missing / slack).max(axis=-1, keepdims=True), 0.0)
    bound = np.where(F.any(axis=-1), x + w * largest * (1 + rounding), g)
    confirmed = is_small & (w > 0).all(axis=-1) & (slack > 0).all(axis=-1)
    return Solution(loop_gain, np.where(confirmed[..., None], bound, np.inf))


def _applied(F: Matrix, v: Vector) -> Vector:
    return np.asarray((F @ v[..., None])[..., 0])


def _eliminated(matrix: Matrix, *right_sides: Vector) -> tuple[Vector, ...]:
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
    """How e_c is bounded. Bounds of parts may be added only if they use the same method."""

    MISSING = "by e_s and by the errors of all missing events"
    DRIFTING = "by its value d ago, and by what has driven it since"


class LoopConstants(NamedTuple):
    """The constants of several loops but δ, (loops,) each: see ``Constants`` in ``terms``."""

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
        own = {name: values[loop].item() for name, values in self._asdict().items()}
        del own["exists"], own["earlier_input_error"]
        return Constants(rate_per_s=rate_per_s, inter_event_s=inter_event_s, **own)


@dataclass
class KnownBounds:
    """Bounds of one loop that hold, each of which may be replaced by a smaller one."""

    signals: Vector
    """Of (q, b, η, π or the start's, sup‖R_E x‖, 1, π), or β̃ for b."""
    states: dict[str, float]
    """Of sup‖C x‖."""
    errors: dict[Output, float]
    """Of sup‖C e_c‖."""
    sensor: float = math.inf
    """Of β̃ = sup‖e_s‖_W."""
    earlier: float = math.inf
    """Of the part of ‖u − Kx‖ that does not come from the present e_s."""
    received: float = math.inf
    """Of ‖u − Kx‖ while no event is missing."""

    @property
    def input_error(self) -> float:
        """π."""
        return self.errors[Output.GAIN] + float(self.signals[0])


class ErrorInequalities:
    """The inequalities of one part, and their solution for assumed spacings of events.

    The part is that of one loop, or of several (:meth:`PlantGains.together`), with the same
    trigger and conditions; spacings and solutions are those of each loop.
    """

    def __init__(self, part: Part, conditions: NetworkConditions, earlier_error: float) -> None:
        self._error, self._plant, self._bound, self._estimation = error, plant, bound, _ = part
        self._conditions = conditions
        self._lost: LossAccumulation | None = None
        self._remainder = error.hold_remainder(conditions.hold_s)
        self._start_error, start = plant.start_up(conditions.start_s)
        self._beyond = np.maximum(self._start_error, earlier_error)
        self._states = {
            output: Coefficients(free + start[output], gain) for output, (free, gain) in plant.states.items()
        }
        self._growths = [list_growths(plant, conditions.sampling_s, part_bound) for part_bound in bound.every]
        self._begin_s = math.inf if earlier_error else conditions.start_s

    def use_windows(self) -> None:
        """Use how many updates may be lost in a window, too."""
        if self._error.decays:
            self._lost = LossAccumulation(self._plant, self._conditions.delay_s)

    @property
    def methods(self) -> Sequence[BoundMethod]:
        """The methods by which e_c can be bounded; the first one is usually the tighter one."""
        if self._conditions.delay_s > 0 and self._error.decays:
            return [BoundMethod.DRIFTING, BoundMethod.MISSING]
        return [BoundMethod.MISSING]

    def constants(self, spacing_s: Vector, method: BoundMethod) -> LoopConstants:
        """Return all constants but δ, given inter-event times of at least ``spacing_s``, (loops,).

        A loop without a certificate has a loop gain that is not below 1, and perhaps infinite.
        """
        conditions = self._conditions
        events = np.full(len(spacing_s), conditions.dropouts)
        is_spaced = spacing_s > 0
        if conditions.delay_s > 0:  # without a spacing, any number of updates may be in flight
            events[is_spaced] += np.ceil(conditions.delay_s / spacing_s[is_spaced]).astype(np.int64)
        is_counted = is_spaced | (conditions.delay_s == 0)
        solved: list[tuple[_Signals, Vector, Matrix]] = []
        for growths in self._growths:  # all bounds of e_s hold; of each, one growth applies
            own = growths[0] if len(growths) == 1 and self._error.decays else None
            signals = self._signals(method, events, spacing_s, own)
            each = [self._solved(signals, growth, own) for growth in growths]
            gain = np.max([one.loop_gain for one in each], axis=0)
            solved.append((signals, gain, np.max([one.bound for one in each], axis=0)))
        smallest = np.min([bound for _, _, bound in solved], axis=0)
        gain = np.where(is_counted, np.min([gain for _, gain, _ in solved], axis=0), np.inf)
        found = []
        for signals, _, bound in solved:  # each b is another one
            bound = np.where(np.arange(_SIGNALS) == 1, bound, smallest)
            found.append(self._found(signals, events, gain, bound, is_counted))
        exists = np.any([one.exists for one in found], axis=0)
        return LoopConstants(*map(np.fmin.reduce, zip(*found, strict=True)))._replace(exists=exists)

    def _found(
        self,
        signals: "_Signals",
        events: Counts,
        loop_gain: Vector,
        solved: Matrix,
        is_counted: NDArray[np.bool_],
    ) -> LoopConstants:
        """Return what follows from bounds of the signals, (loops, 7)."""
        states = signals.free + _applied(signals.states, solved)
        state = dict(zip(self._states, np.moveaxis(states, -1, 0), strict=True))
        held, estimation = solved[..., 0], solved[..., 2]
        found = (
            (_product(signals.errors[Output.WEIGHTED], solved) + estimation) / self.unit,
            (_product(signals.sensor, solved) + estimation) / self.unit,
            _product(signals.errors[Output.GAIN], solved) + held,
            self._start_error,
            state[Output.STATE],
            state[Output.WEIGHTED],
            state[Output.MISMATCH],
            loop_gain,
            estimation,
            _product(signals.received, solved) + held,
            _product(signals.earlier, solved) + held,
            np.isfinite(solved).all(axis=-1) & is_counted,
        )
        return LoopConstants(events, *(np.broadcast_to(values, events.shape) for values in found))

    @property
    def unit(self) -> float:
        """The unit of Δ and β̃/β."""
        return self._bound.beta if self._bound.unit is None else self._bound.unit

    def _signals(
        self, method: BoundMethod, events: Counts, spacing_s: Vector, own: ErrorGrowth | None
    ) -> "_Signals":
        """Return how all outputs depend on (q, b, η, π̄, sup‖R_E x‖, 1, π).

        Every ‖e_s‖_W has grown by ``own`` from at most b at the last test; without it b is β̃. An
        event's x_s − x̂ is at most this plus η, the present x_s − x is at most this.
        """
        held, test, estimated, *_ = np.eye(_SIGNALS)
        sensor = test
        if own is not None:
            sensor = self._split(_columns(0.0, own.stretch, 0.0, *own.driven, 0.0), own.highest)
        present = {output: self._present(output, own) for output in self._error.outputs}
        received, dropouts = present[Output.GAIN], np.full_like(events, self._conditions.dropouts)

        def missing(output: Output, count: Counts) -> Matrix:
            return self._missing(output, count, spacing_s, own)

        if method is BoundMethod.DRIFTING:
            # d ago, e_c consisted of e_s and of the errors of events that are lost.
            delay_s = self._conditions.delay_s
            present = {output: self._present(output, own, delay_s) for output in present}
            errors = {output: row + missing(output, dropouts) for output, row in present.items()}
            earlier, near = errors[Output.GAIN], present[Output.GAIN]
        else:
            gone = {output: missing(output, events) for output in present}
            errors = {output: row + gone[output] for output, row in present.items()}
            earlier = gone[Output.GAIN]
            near = received + missing(Output.GAIN, events - dropouts)
        if own is not None:
            sups = {output: kernels[0].sup() for output, kernels in self._plant.driven.items()}
            errors = {output: self._split(row, sups[output]) for output, row in errors.items()}
            received, earlier, near = (
                self._split(row, sups[Output.GAIN]) for row in (received, earlier, near)
            )
        whole = errors[Output.GAIN]
        lost = whole[..., 1] - near[..., 1]
        alone = self._alone(lost, spacing_s)
        states = []
        for name, (_, gain) in self._states.items():
            gain = np.asarray(gain)[..., None]
            row = gain * (held + whole)
            if name in alone:
                in_windows = gain * (held + near) + alone[name][:, None] * (sensor + estimated)
                row = np.where((alone[name] < gain[..., 0] * lost)[:, None], in_windows, row)
            states.append(row)
        free = _columns(*(state.free for state in self._states.values()))
        rows = _rows(*states)
        return _Signals([*self._states], free, rows, errors, sensor, received, earlier)

    def _present(self, output: Output, own: ErrorGrowth | None, later_s: float = 0.0) -> Matrix:
        """Return the bound of sup‖C e_s‖ as a row of the signals.

        It is that of what e_s becomes, if nothing resets it, up to ``later_s`` after.
        """
        until_s, still = later_s + (0.0 if own is None else own.longest_s), np.zeros(())
        driven: tuple[Vector, Vector, Vector] = (still, still, still)
        if until_s > 0:
            growth = self._plant.growths(until_s, COARSE_CELLS)[output]
            driven = growth.totals if own is None else growth.means(own.ages_s + later_s)
        return _columns(0.0, self._error.now_until(until_s)[output], 0.0, *driven, 0.0)

    def _split(self, row: Matrix, highest: Vector) -> Matrix:
        """Split what the input error drives: ‖p‖ > π only before the first input.

        ``highest`` bounds what a p of 1 adds in a unit of time.
        """
        if self._begin_s == math.inf:
            return row
        row = row.copy()
        beyond = np.minimum(row[..., _BEGUN], self._begin_s * highest)
        row[..., _LATER] += row[..., _BEGUN] - beyond
        row[..., _BEGUN] = beyond
        return row

    def _missing(self, output: Output, events: Counts, spacing_s: Vector, own: ErrorGrowth | None) -> Matrix:
        """Return the bound of the part of sup‖C e_c‖ from missing events as a row of the signals.

        The part of e_s that has grown since the last test is followed from where it entered.
        """
        gain = self._missing_gain(output, events, spacing_s)
        if own is None:
            return _columns(0.0, gain, gain, 0.0, 0.0, 0.0, 0.0)
        driven = [gain * size for size in own.driven]
        if own.longest_s > 0:
            for place, kernel in enumerate(self._plant.driven[output]):
                followed = own.mean_s * sum_of_sups(kernel, events, spacing_s)
                driven[place] = np.minimum(driven[place], followed)
        return _columns(0.0, gain, gain, *driven, 0.0)

    def _solved(self, signals: "_Signals", growing: ErrorGrowth, own: ErrorGrowth | None) -> Solution:
        """Return the loop gains, (loops,), and the bounds of the signals, (loops, 7)."""
        errors, beyond, held = signals.errors, self._beyond, self.age_gains
        held_input, _, estimated, *_ = np.eye(_SIGNALS)
        input_error = errors[Output.GAIN] + held_input

        through, free = signals.through({str(C): gain for C, gain in held.items()})
        from_errors = sum(gain * errors[output] for output, gain in held.items())
        of_age = (through + from_errors, free)
        estimation = self._estimation
        through, free = signals.through(estimation.shares)
        of_estimate = (
            through + estimation.from_input * input_error,
            estimation.fixed + free + estimation.from_input * beyond,
        )
        of_mismatch = signals.through({Output.MISMATCH: 1.0})
        through, free = signals.through(growing.shares)
        of_test = (through + growing.estimation * estimated, growing.fixed + free)
        if own is None:
            by_input, mismatched, forced = growing.driven
            driven = _columns(0.0, 0.0, 0.0, by_input, mismatched, 0.0, 0.0)
            of_test = (
                growing.stretch * of_test[0] + self._split(driven, growing.highest),
                growing.stretch * of_test[1] + forced,
            )
        others = ((input_error, beyond), of_mismatch, (0.0 * input_error, 1.0), (input_error, 0.0))
        each = (of_age, of_test, of_estimate, *others)
        rows = _rows(*(row for row, _ in each))
        right = _columns(*(right for _, right in each))
        return solve_inequalities(rows, np.broadcast_to(right, rows.shape[:-1]))

    def known(self, spacing_s: float) -> KnownBounds:
        """Return the bounds of one loop with one bound of e_s; infinite without a certificate."""
        (growths,) = self._growths
        own = growths[0] if len(growths) == 1 else None
        solved = [
            np.max([self._solved(signals, one, own).bound[0] for one in growths], axis=0)
            for signals in self._each_method(spacing_s)
        ]
        states, errors = (
            dict.fromkeys(self._states, math.inf),
            dict.fromkeys(self._error.outputs, math.inf),
        )
        return KnownBounds(np.min(solved, axis=0), states, errors)

    def insert(self, known: KnownBounds, spacing_s: float) -> None:
        """Insert bounds that hold into all inequalities of one loop, to make them smaller."""
        (growths,), v, states, errors = self._growths, known.signals, known.states, known.errors
        for method in self._each_method(spacing_s):
            for output, row in method.errors.items():
                errors[output] = min(errors[output], float(row[0] @ v))
            known.sensor = min(known.sensor, float(method.sensor @ v))
            known.received = min(known.received, float(method.received @ v + v[0]))
        known.earlier = min(known.earlier, float(method.earlier[0] @ v + v[0]))
        for name, (free, gain) in self._states.items():
            states[name] = min(states[name], float(free + gain * known.input_error))
        age = sum(gain * (states[C] + errors[C]) for C, gain in self.age_gains.items())
        tested = []
        for growth in growths:
            b = growth.fixed + sum(share * states[C] for C, share in growth.shares.items())
            driven = self._split(_columns(0.0, growth.stretch, 0.0, *growth.driven, 0.0), growth.highest)
            grown = float(driven @ np.array([0.0, b, *v[2:]]))
            tested.append(b if len(growths) == 1 else grown)
        beyond = max(known.input_error, self.start_error)
        found = [age, max(tested), 0.0, beyond, states[Output.MISMATCH], 1.0, known.input_error]
        known.signals = np.minimum(v, np.array(found, dtype=np.float64))

    @property
    def start_error(self) -> float:
        """sup‖u − Kx‖ of one loop before the first input."""
        return float(self._beyond)

    @property
    def age_gains(self) -> Mapping[Output, float]:
        """The part of ‖u − Kx‖ due to the input's age is at most Σ gain_C sup‖C x_c‖."""
        hold_s = self._conditions.hold_s
        return {
            Output.GAIN_RATE: hold_s,
            Output.GAIN_CURVATURE: hold_s**2 / 2,
            Output.WEIGHTED: self._remainder,
        }

    def next_event_s(self, known: KnownBounds) -> float:
        """Return the time between two events that follows from bounds; 0 if there is none."""
        if all(bound.reached is None for bound in self._bound.every):
            return 0.0
        still, never = np.zeros(1), np.zeros(1, dtype=bool)
        events = np.zeros(1, dtype=np.int64)
        mismatch, earlier = known.signals[4:5], still + known.earlier
        before, after = (still,) * 6, (still,) * 3
        constants = LoopConstants(events, *before, mismatch, *after, earlier, ~never)
        return float(self.inter_event_s(constants, never, ~never)[0])

    @cached_method
    def _each_method(self, spacing_s: float) -> "list[_Signals]":
        """Return the signals by each method, the one by missing events last."""
        conditions, events = self._conditions, np.full(1, self._conditions.dropouts)
        if conditions.delay_s > 0:
            events = events + math.ceil(conditions.delay_s / spacing_s)
        growths = self._growths[0]
        own = growths[0] if len(growths) == 1 else None
        spacing = np.array([spacing_s])
        return [self._signals(method, events, spacing, own) for method in self.methods]

    def _missing_gain(self, output: Output, events: Counts, spacing_s: Vector) -> Vector:
        if self._error.decays or math.isinf(self._bound.due_s):
            return self._error.missing(output, events, spacing_s)
        return self._error.missing_until(output, events, self._bound.due_s)

    def _alone(self, lost: Vector, spacing_s: Vector) -> Mapping[str, Vector]:
        """Return S_C for every output, from the losses in windows; infinite where it is not needed.

        It is computed only where it can be smaller: where all lost updates together have less
        effect than the longest burst at its largest, ``lost``.
        """
        if self._lost is None:
            return {}
        windows = self._conditions.guarantee.windows
        density = min(window.losses / window.packets for window in windows)
        lasting = density * self._error.kernels[Output.GAIN].integral()
        which = np.flatnonzero(lasting < lost * spacing_s).tolist()
        found: dict[str, Vector] = {}
        for output in self._states if which else ():
            found[output] = np.full(len(spacing_s), np.inf)
            for loop in which:
                total = self._lost.total(output, float(spacing_s[loop]), windows, loop)
                found[output][loop] = total
        return found

    def inter_event_s(
        self,
        constants: LoopConstants,
        drifts: NDArray[np.bool_],
        searched: NDArray[np.bool_],
    ) -> Vector:
        """Return the times that ‖e_s‖_W needs to the next event, given the constants until then.

        Args:
            constants: of all loops.
            drifts: where the method is ``DRIFTING``, (loops,).
            searched: the loops whose times are needed, (loops,); the others are of no use.
        """
        # The part of D_K that is the e_s of now.
        own = np.where(drifts, 0.0, self._error.now(Output.GAIN))
        others = constants.earlier_input_error
        estimation = np.where(searched, constants.estimation_error, 0.0)
        # After an event e_s is the estimation error, and x_s − x̂ differs from e_s by one, too.
        times_s = [
            np.minimum(
                first_passage_s(
                    self._plant,
                    np.where(searched, bound.reached - estimation, 0.0),
                    np.where(searched, constants.mismatch, 0.0),
                    np.where(searched, np.maximum(others, self._beyond), 0.0),
                    own,
                    estimation,
                ),
                bound.ago_s or math.inf,
            )
            for bound in self._bound.every
            if bound.reached is not None
        ]
        found_s = np.max(times_s, axis=0)
        found_s = np.maximum(np.minimum(found_s, self._bound.forced_s), self._bound.apart_s)
        if (grid_s := self._conditions.spacing_s) == 0:
            return np.asarray(found_s)
        return np.asarray(grid_s * np.maximum(np.ceil(found_s / grid_s - 1e-9), 1.0))


class _Signals(NamedTuple):
    """The outputs of x and e_c as linear functions of (q, b, η, π̄, sup‖R_E x‖, 1, π).

    η = sup‖x̂ − x‖_W, and b bounds ‖e_s‖_W after each test, or is β̃.
    """

    names: list[str]
    free: Vector
    """(…, k) the constant part of sup‖C x‖."""
    states: Matrix
    """(…, k, 7)"""
    errors: Mapping[Output, Vector]
    """(…, 7) of sup‖C e_c‖."""
    sensor: Vector
    """(…, 7) of β̃ = sup‖e_s‖_W."""
    received: Vector
    """(…, 7) of sup‖K e_c‖ while no event is missing."""
    earlier: Vector
    """(…, 7) of the part of sup‖K e_c‖ that does not come from the present e_s."""

    def through(self, gains: Mapping[str, Vector | float]) -> tuple[Vector, Vector]:
        """Return Σ_C gain_C sup‖C x‖ by its linear, (…, 7), and its constant part, (…)."""
        row = _columns(*(gains.get(name, 0.0) for name in self.names))
        return np.asarray((row[..., None, :] @ self.states)[..., 0, :]), _product(row, self.free)


def _product(row: Vector, column: Vector) -> Vector:
    """Return the scalar products of vectors, (…, k)."""
    return np.asarray((row[..., None, :] @ column[..., None])[..., 0, 0])


def _columns(*values: Vector | float) -> Matrix:
    """Return values of loops, (…), side by side, (…, k)."""
    found = np.empty((*np.broadcast(*values).shape, len(values)))
    for place, value in enumerate(values):
        found[..., place] = value
    return found


def _rows(*values: Vector) -> Matrix:
    """Return vectors of loops, (…, j), one below the other, (…, k, j)."""
    *lead, size = np.broadcast(*values).shape
    found = np.empty((*lead, len(values), size))
    for place, value in enumerate(values):
        found[..., place, :] = value
    return found
