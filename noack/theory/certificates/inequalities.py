"""The inequalities (I1) of a certificate, solved for an assumed spacing of events.

Assumptions: the trigger ‖e_s‖_W > βe^{−αt} is tested at least every h seconds, the network keeps
its guarantee about losses, and the input is held. With all signals scaled by e^{αt}:

    sup‖C e_c‖  ≤ (‖C W⁻¹‖ + Σ_{j<N} sup_{τ≥jδ} ‖C e^{(H+αI)τ} W⁻¹‖) β̃ = D_C β̃          (I1)
    sup‖C x‖    ≤ free_C + gain_C q + Γ_C β̃,   Γ_C ≤ gain_C D_K       (plant, input error p)
    q           ≤ Σ_{C = σKH, ½σ²KH², r(σ)W} (sup‖C x‖ + D_C β̃)       (input of age ≤ σ)
    π = sup‖p‖  ≤ D_K β̃ + q
    β̃ = sup‖e_s‖_W ≤ ḡβ + I_E sup‖R_E x‖ + I_B π                      (between two tests)

with at most N missing events: the longest burst of losses, and ⌈d/δ⌉ in flight. A policy's
threshold may contain more than β (:mod:`noack.theory.bounds.trigger_bounds`), and Γ_C is smaller if
few updates may be lost in a window (:mod:`noack.theory.certificates.loss_accumulation`). These
inequalities are linear in q and β̃ and hold on every [0, T]. So their solution bounds the run if
the loop gain is below 1.

**Solution.** For v ≤ F v + g with F, g ≥ 0: if some w > 0 has F w < w, the spectral radius of F is
below 1, and v ≤ x for every x with x − F x ≥ g. Both are checked with a bound of all rounding, so
nothing depends on how w and x were computed. x begins as the computed (I − F)⁻¹ g. Where x − F x
misses g by r, adding w max r/(w − F w) is enough.
"""

import math
from collections.abc import Mapping, Sequence
from enum import Enum
from functools import cached_property
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix, Vector
from noack.theory.bounds.gains import Coefficients, Counts, Output
from noack.theory.bounds.terms import Constants, NetworkConditions, Part
from noack.theory.bounds.trigger_bounds import (
    COARSE_CELLS,
    ErrorGrowth,
    first_passage_s,
    list_growths,
)
from noack.theory.certificates.loss_accumulation import LossAccumulation

_SIGNALS = 6
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
    exists: NDArray[np.bool_]
    """Where there is a certificate; of the others only ``loop_gain`` is of use."""

    def of_loop(self, loop: int, rate_per_s: float, inter_event_s: float | None) -> Constants:
        """Return the constants of one loop."""
        own = {name: values[loop].item() for name, values in self._asdict().items()}
        del own["exists"]
        return Constants(rate_per_s=rate_per_s, inter_event_s=inter_event_s, **own)


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
            output: Coefficients(free + start[output], gain)
            for output, (free, gain) in plant.states.items()
        }
        self._growths = [
            list_growths(plant, conditions.sampling_s, part_bound) for part_bound in bound.every
        ]

    def use_windows(self) -> None:
        """Use how many updates may be lost in a window, too."""
        if self._error.decays:
            self._lost = LossAccumulation(self._plant, self._conditions.delay_s)

    @property
    def methods(self) -> Sequence[BoundMethod]:
        """The methods by which e_c can be bounded."""
        if self._conditions.delay_s > 0 and self._error.decays:
            return [*BoundMethod]
        return [BoundMethod.MISSING]

    def constants(self, spacing_s: Vector, method: BoundMethod) -> LoopConstants:
        """Return all constants but δ, given inter-event times of at least ``spacing_s``, (loops,).

        A loop without a certificate has a loop gain that is not below 1, and perhaps infinite.
        """
        conditions, error = self._conditions, self._error
        events = np.full(len(spacing_s), conditions.dropouts)
        is_spaced = spacing_s > 0
        if conditions.delay_s > 0:  # without a spacing, any number of updates may be in flight
            events[is_spaced] += np.ceil(conditions.delay_s / spacing_s[is_spaced]).astype(np.int64)
        if method is BoundMethod.DRIFTING:
            bound = self._drifting(spacing_s)
        else:
            gains = {C: self._missing_gain(C, events, spacing_s) for C in error.outputs}
            in_flight = self._missing_gain(Output.GAIN, events - conditions.dropouts, spacing_s)
            bound = _ErrorBound({C: error.now(C) for C in error.outputs}, gains, in_flight)
        signals = self._signals(bound, self._from_errors(bound, spacing_s))
        loop_gain, solved = self._solved(signals)
        if conditions.delay_s > 0:
            loop_gain = np.where(is_spaced, loop_gain, np.inf)
        sensor_error = solved[..., 1] + solved[..., 2]
        states = signals.free + _applied(signals.states, solved)
        state = dict(zip(self._states, np.moveaxis(states, -1, 0), strict=True))

        def of_error(output: Output) -> Vector:
            return _product(signals.errors[output], solved)

        found = (
            (of_error(Output.WEIGHTED) + solved[..., 2]) / self.unit,
            sensor_error / self.unit,
            of_error(Output.GAIN) + solved[..., 0],
            self._start_error,
            state[Output.STATE],
            state[Output.WEIGHTED],
            state[Output.MISMATCH],
            loop_gain,
            solved[..., 2],
            error.now(Output.GAIN) * solved[..., 1] + solved[..., 0],
            np.isfinite(solved).all(axis=-1) & (is_spaced | (conditions.delay_s == 0)),
        )
        columns = (np.broadcast_to(values, events.shape) for values in found)
        return LoopConstants(events, *columns)

    def _drifting(self, spacing_s: Vector) -> "_ErrorBound":
        """Return the bound of e_c by its value d ago, and by what has driven it since.

        d ago, e_c consisted of e_s and of the errors of events that are lost.
        """
        error, dropouts, kernels = self._error, self._conditions.dropouts, self._error.kernels
        return _ErrorBound(
            {output: float(kernel.sup()) for output, kernel in kernels.items()},
            {output: error.missing(output, dropouts, spacing_s) for output in kernels},
            np.zeros(()),
            self._drift,
        )

    @cached_property
    def _drift(self) -> Mapping[Output, tuple[Vector, Vector, Vector]]:
        growths = self._plant.growths(self._conditions.delay_s, COARSE_CELLS)
        return {output: growth.totals for output, growth in growths.items()}

    @property
    def unit(self) -> float:
        """The unit of Δ and β̃/β."""
        return self._bound.beta if self._bound.unit is None else self._bound.unit

    def _signals(self, bound: "_ErrorBound", from_errors: Mapping[str, Vector]) -> "_Signals":
        """Return how all outputs depend on (q, β̃, η, π, sup‖R_E x‖, 1).

        An event's x_s − x̂ is at most β̃ + η, the present x_s − x at most β̃.
        """
        still = (0.0, 0.0, 0.0)
        by_input = bound.drift.get(Output.GAIN, still)
        present = bound.present[Output.GAIN]
        states = [
            _columns(
                gain, from_errors[name], from_errors[name] - gain * present,
                *(gain * driven for driven in by_input),
            )
            for name, (_, gain) in self._states.items()
        ]  # fmt: skip
        errors = {
            output: _columns(0.0, now + gone, gone, *bound.drift.get(output, still))
            for (output, now), gone in zip(
                bound.present.items(), bound.missing.values(), strict=True
            )
        }
        free = _columns(*(state.free for state in self._states.values()))
        return _Signals(list(self._states), free, _rows(*states), errors)

    def _solved(self, signals: "_Signals") -> tuple[Vector, Matrix]:
        """Return the loop gains, (loops,), and the bounds of the signals, (loops, 6).

        The bounds are infinite where the loop gain is not below 1.
        """
        errors, hold_s, beyond = signals.errors, self._conditions.hold_s, self._beyond
        held: dict[str, float] = {
            Output.GAIN_RATE: hold_s,
            Output.GAIN_CURVATURE: hold_s**2 / 2,
            Output.WEIGHTED: self._remainder,
        }
        held_input, _, estimated, *_ = np.eye(_SIGNALS)
        input_error = errors[Output.GAIN] + held_input

        through, free = signals.through(held)
        from_errors = sum(gain * errors[Output(output)] for output, gain in held.items())
        of_age = (through + from_errors, free)
        estimation = self._estimation
        through, free = signals.through(estimation.shares)
        of_estimate = (
            through + estimation.from_input * input_error,
            estimation.fixed + free + estimation.from_input * beyond,
        )
        of_mismatch = signals.through({Output.MISMATCH: 1.0})
        others = ((input_error, beyond), of_mismatch, (0.0 * input_error, 1.0))

        def solved(growing: ErrorGrowth) -> Solution:
            through, free = signals.through(growing.shares)
            F = through + np.asarray(growing.input_error)[..., None] * input_error
            F = F + np.asarray(growing.estimation)[..., None] * estimated
            fixed = growing.fixed + free + growing.input_error * beyond
            each = (of_age, (F, fixed), of_estimate, *others)
            rows = _rows(*(row for row, _ in each))
            return solve_inequalities(rows, np.broadcast_to(
                _columns(*(right for _, right in each)), rows.shape[:-1]
            ))  # fmt: skip

        # Of each bound one growth applies, and all bounds hold.
        each = [[solved(growth) for growth in growths] for growths in self._growths]
        gains = [np.max([one.loop_gain for one in solutions], axis=0) for solutions in each]
        bounds = [np.max([one.bound for one in solutions], axis=0) for solutions in each]
        return np.min(gains, axis=0), np.min(bounds, axis=0)

    def _missing_gain(self, output: Output, events: Counts, spacing_s: Vector) -> Vector:
        if self._error.decays or math.isinf(self._bound.due_s):
            return self._error.missing(output, events, spacing_s)
        return self._error.missing_until(output, events, self._bound.due_s)

    def _from_errors(self, bound: "_ErrorBound", spacing_s: Vector) -> Mapping[str, Vector]:
        """Return Γ_C for every output, from D_K and from the losses in windows.

        The second is computed only where it can be smaller: where all lost updates together have
        less effect than the longest burst at its largest.
        """
        present = bound.present[Output.GAIN] + bound.in_flight
        share = bound.present[Output.GAIN] + bound.missing[Output.GAIN]
        sizes = {output: gain * share for output, (_, gain) in self._states.items()}
        if self._lost is None:
            return sizes
        windows = self._conditions.guarantee.windows
        density = min(window.losses / window.packets for window in windows)
        lasting = density * self._error.kernels[Output.GAIN].integral()
        which = np.flatnonzero(lasting < (share - present) * spacing_s).tolist()
        if not which:
            return sizes
        for output, (_, gain) in self._states.items():
            alone = np.full(len(spacing_s), np.inf)
            for loop in which:
                alone[loop] = self._lost.total(output, float(spacing_s[loop]), windows, loop)
            sizes[output] = np.minimum(sizes[output], gain * present + alone)
        return sizes

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
        sensor_error = constants.overshoot * self.unit - constants.estimation_error
        others = constants.input_error - own * sensor_error
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


class _ErrorBound(NamedTuple):
    """sup‖C e_c‖ ≤ (present_C + missing_C) β̃ + drift_C · (π, sup‖R_E x‖, 1), for every output C."""

    present: Mapping[Output, float]
    """The gain of e_s, now or where the drift begins."""
    missing: Mapping[Output, Vector]
    """The gain of the events that are missing then."""
    in_flight: Vector
    """The part of missing_K that is not lost."""
    drift: Mapping[Output, tuple[Vector, Vector, Vector]] = MappingProxyType({})
    """The gains of what has driven e_c since then; none without a delay."""


class _Signals(NamedTuple):
    """The outputs of x and e_c as linear functions of (q, β̃, η, π, sup‖R_E x‖, 1).

    η = sup‖x̂ − x‖_W.
    """

    names: list[str]
    free: Vector
    """(…, k) the constant part of sup‖C x‖."""
    states: Matrix
    """(…, k, 6)"""
    errors: Mapping[Output, Vector]
    """(…, 6) of sup‖C e_c‖."""

    def through(self, gains: Mapping[str, Vector | float]) -> tuple[Vector, Vector]:
        """Return Σ_C gain_C sup‖C x‖ by its linear, (…, 6), and its constant part, (…)."""
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
