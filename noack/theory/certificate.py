"""Tight certificates: guaranteed bounds of a loop, their conditions and their constants.

Assumptions: the trigger ‖e_s‖_W > βe^{−αt} is tested at least every h seconds, the network keeps
its guarantee about losses, and the input is held. With all signals scaled by e^{αt}:

    sup‖C e_c‖  ≤ (‖C W⁻¹‖ + Σ_{j<N} sup_{τ≥jδ} ‖C e^{(H+αI)τ} W⁻¹‖) β̃ = D_C β̃          (I1)
    sup‖C x‖    ≤ free_C + gain_C q + Γ_C β̃,   Γ_C ≤ gain_C D_K       (plant, input error p)
    q           ≤ Σ_{C = σKH, ½σ²KH², r(σ)W} (sup‖C x‖ + D_C β̃)       (input of age ≤ σ)
    π = sup‖p‖  ≤ D_K β̃ + q
    β̃ = sup‖e_s‖_W ≤ ḡβ + I_E sup‖R_E x‖ + I_B π                      (between two tests)

with at most N missing events: the longest burst of losses, and ⌈d/δ⌉ in flight. Γ_C is smaller if
few updates may be lost in a window (:mod:`noack.theory.loss_accumulation`). A policy's threshold
may contain more than β (:mod:`noack.theory.error_growth`). These inequalities are linear in q and β̃
and hold on every [0, T]. So their solution (:mod:`noack.theory.nonnegative_system`) bounds the run
if the loop gain is below 1. The minimum inter-event time δ is the time that ‖e_s‖_W needs from 0 to
β under these bounds. If an assumed δ gives a time of at least δ, it holds by induction over the
events; the largest such δ is used.
"""

import contextlib
import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix, Vector, spectral_abscissa
from noack.impairments.loss_guarantee import LongestBurst, LossGuarantee, LossRule
from noack.theory.enclosure import NotDecayingError
from noack.theory.error_growth import (
    COARSE_CELLS,
    LONGEST_S,
    ErrorGrowth,
    TriggerBound,
    first_passage_s,
    growths_of,
)
from noack.theory.gains import Coefficients, ErrorGains, Output, PlantGains
from noack.theory.loss_accumulation import LossAccumulation
from noack.theory.nonnegative_system import Solution, solve_inequalities
from noack.theory.sharpened_bounds import InvariantEllipsoids, SharpenedBounds

_SETTLED = 1e-3
_SHARPER = 0.99
"""Bounds from the flow are computed again if Δ has become smaller by this factor."""
_ATTEMPTS = 200
_SIGNALS = 6


class NetworkConditions(NamedTuple):
    """The assumptions of a certificate about network and schedule, in the plant's time."""

    dropouts: int
    """The largest number of consecutive losses: M − 1, or less by further constraints."""
    sampling_s: float = 0.0
    """h, the longest time between two tests of the trigger; 0 is a continuous trigger."""
    spacing_s: float = 0.0
    """The shortest time between two tests; all other times between tests are multiples of it."""
    delay_s: float = 0.0
    """d, the longest time from an event until a delivered update affects the plant's input."""
    hold_s: float = 0.0
    """σ, the largest difference between the time and the model time of the applied input."""
    start_s: float = 0.0
    """Time from which the plant applies the controller's input; before, its input is 0."""
    constraints: tuple[LossRule, ...] = ()
    """Further rules of the guarantee."""

    @property
    def guarantee(self) -> LossGuarantee:
        """All rules that the network keeps."""
        return LossGuarantee((LongestBurst(self.dropouts), *self.constraints))


class Constants(NamedTuple):
    """The constants of a certificate; ‖·‖_W is the trigger's norm, ‖·‖ the Euclidean."""

    rate_per_s: float
    """Every bound decays like e^{−rate·t}."""
    missing_events: int
    """N, the largest number of events whose updates the controller does not have."""
    delta: float
    """Δ: ‖e_c‖_W ≤ Δβe^{−αt}."""
    overshoot: float
    """β̃/β: ‖e_s‖_W ≤ β̃e^{−αt}."""
    input_error: float
    """π: ‖u − Kx‖ ≤ πe^{−αt}, from the first applied input of the controller on."""
    start_error: float
    """The same before the first applied input, when u = 0."""
    state: float
    """X: ‖x‖ ≤ Xe^{−αt}."""
    state_weighted: float
    """X_W: ‖x‖_W ≤ X_W e^{−αt}."""
    mismatch: float
    """‖E x‖_W ≤ mismatch · e^{−αt}: the rate at which the model deviates from the plant."""
    inter_event_s: float | None
    """δ, lower bound of the inter-event time; None if there is no such bound."""
    loop_gain: float
    """Loop gain of the errors (small-gain condition); below 1."""
    estimation_error: float = 0.0
    """‖x̂ − x‖_W at the measurements. Where it is not 0, e_s and e_c are x_s − x̂ and x_c − x̂."""
    received_input_error: float = 0.0
    """The same as π while the controller has every update: ‖KW^{−1}‖β̃ + q."""


class VoidError(ArithmeticError):
    """There is no certificate; the message has the reason."""

    def __init__(self, reason: str, loop_gain: float = math.inf) -> None:
        super().__init__(reason)
        self.loop_gain = loop_gain


class EstimationBound(NamedTuple):
    """Bound of the estimation error at every measurement, where the trigger tests x̂ instead of x.

    ‖x̂ − x‖_W ≤ fixed + Σ_C share_C sup‖C x‖ + from_input sup‖p‖
    """

    fixed: float = 0.0
    """From noise, disturbances and the first estimate."""
    shares: Mapping[str, float] = MappingProxyType({})
    """share_C by the name of C in :attr:`PlantGains.outputs`: the plant is not the model."""
    from_input: float = 0.0


_MEASURED = EstimationBound()


def solve(
    error: ErrorGains,
    plant: PlantGains,
    conditions: NetworkConditions,
    bound: TriggerBound,
    earlier_error: float = 0.0,
    *,
    estimation: EstimationBound = _MEASURED,
    structured: bool = True,
    longest: bool = True,
) -> Constants:
    """Return the constants that are certified for all times.

    ``structured``: at every time, p = u − Kx consists of the errors of the events and of the age of
    the input. Otherwise it is only known that its norm is at most π.

    ``earlier_error``: bound of sup‖p‖ while the plant still applies inputs of an earlier run.
    ``longest``: search for the longest δ; otherwise only if there is no certificate without it.

    Raises:
        VoidError: the loop gain is not below 1.
        NotDecayingError: a mode of the loop decays more slowly than the threshold.
    """
    part = Part(error, plant, bound, estimation)
    (found,) = solve_sum([part], conditions, earlier_error, structured=structured, longest=longest)
    if longest and structured and earlier_error == 0.0 and _is_reset_flow(part, conditions):
        with contextlib.suppress(np.linalg.LinAlgError, NotDecayingError):
            return _sharpened(found, part, conditions)
    return found


def _is_reset_flow(part: "Part", conditions: NetworkConditions) -> bool:
    """Return whether a loop without inputs follows each delivery, and a test at every time.

    Then :mod:`noack.theory.sharpened_bounds` applies.
    """
    error, plant, bound, estimation = part
    is_ideal = conditions == NetworkConditions(
        conditions.dropouts, constraints=conditions.constraints
    )
    is_plain = bound == TriggerBound(bound.beta, bound.reached, bound.shares, unit=bound.unit)
    is_known = plant.is_one_plant and plant.forcing is None and estimation == _MEASURED
    rates_agree = plant.alpha_per_s == error.alpha_per_s
    return (
        is_ideal and is_plain and is_known and rates_agree and spectral_abscissa(error.scaled_H) < 0
    )


def _sharpened(found: Constants, part: "Part", conditions: NetworkConditions) -> Constants:
    """Return the constants with the bounds from the flow between deliveries."""
    error, plant, bound, _ = part
    dropouts, unit = conditions.dropouts, bound.beta if bound.unit is None else bound.unit
    size = found.overshoot * unit

    def plain(spacing_s: float | None) -> Vector:
        """Bound ‖e_c‖_W while at most 0, 1, … events are missing."""
        missing = [error.missing(Output.WEIGHTED, j, spacing_s or 0.0) for j in range(dropouts + 1)]
        return (1 + np.array(missing)) * size

    errors = plain(found.inter_event_s)
    ellipsoids = InvariantEllipsoids(plant, float(errors[-1]))
    while True:
        before = found
        known = SharpenedBounds(
            found.input_error,
            found.state,
            found.state_weighted,
            found.mismatch,
            found.inter_event_s,
        )
        known, errors = ellipsoids.sharpened(known, errors, bound.reached, size)
        errors = np.minimum(errors, plain(known.inter_event_s))
        delta = float(errors[-1]) / unit
        found = found._replace(**known._asdict(), delta=min(delta, found.delta))
        if not found.delta < _SHARPER * before.delta:
            return found


class Part(NamedTuple):
    """One of several bounds that are added: with its own decay rate and its own causes."""

    error: ErrorGains
    plant: PlantGains
    bound: TriggerBound
    estimation: EstimationBound = _MEASURED


def solve_sum(
    parts: Sequence[Part],
    conditions: NetworkConditions,
    earlier_error: float = 0.0,
    *,
    structured: bool = True,
    longest: bool = True,
) -> list[Constants]:
    """Return the constants of several parts, whose bounds hold when they are added.

    All inequalities are linear in functions of time, for given events. So the causes may be
    divided: what decays is one part, what persists another one. The threshold is at least the sum
    of the parts' ``reached``, so the next event needs one part that reaches its own. The
    ``earlier_error`` is that of the first part.

    Raises: as :func:`solve`.
    """
    first, *others = parts
    steps = [_Step(first, conditions, earlier_error)]
    steps += [_Step(part, conditions, 0.0) for part in others]
    if structured and parts[0].plant.is_one_plant:
        for step in steps:
            step.use_windows()

    def constants(spacing_s: float, inter_event_s: float | None) -> list[Constants]:
        return [step.constants(spacing_s, inter_event_s) for step in steps]

    apart_s = max(part.bound.apart_s for part in parts)
    least_s = max(conditions.spacing_s, apart_s)
    if any(all(one.reached is None for one in part.bound.every) for part in parts):
        return constants(least_s, apart_s or None)
    void = None
    if not longest:
        try:
            return constants(least_s, least_s or None)
        except VoidError as error:
            void = error
    spacing_s = LONGEST_S
    for _ in range(_ATTEMPTS):
        if spacing_s <= least_s:
            break
        found_s = math.inf
        try:
            for step in reversed(steps):  # what persists usually comes first
                found_s = min(found_s, step.inter_event_s(spacing_s))
                if found_s <= least_s:
                    break
        except VoidError:
            break
        if found_s >= spacing_s:
            return constants(spacing_s, spacing_s)
        # Iterate from above to the largest spacing that is consistent with itself.
        spacing_s = found_s if found_s < (1 - _SETTLED) * spacing_s else (1 - _SETTLED) * found_s
    if void is not None:
        raise void
    return constants(least_s, least_s or None)


class _Step:
    """One iteration: all constants for an assumed spacing of events."""

    def __init__(self, part: Part, conditions: NetworkConditions, earlier_error: float) -> None:
        self._error, self._plant, self._bound, self._estimation = error, plant, bound, _ = part
        self._conditions = conditions
        self._lost: LossAccumulation | None = None
        self._remainder = error.hold_remainder(conditions.hold_s)
        self._start_error, start = plant.start_up(conditions.start_s)
        self._beyond = max(self._start_error, earlier_error)
        self._states = {
            output: Coefficients(free + start[output], gain)
            for output, (free, gain) in plant.states.items()
        }
        self._growths = [growths_of(plant, conditions.sampling_s, one) for one in bound.every]

    def use_windows(self) -> None:
        """Use how many updates may be lost in a window, too."""
        if self._error.decays:
            self._lost = LossAccumulation(self._plant, self._conditions.delay_s)

    def constants(self, spacing_s: float, inter_event_s: float | None) -> Constants:
        """Return all constants, given inter-event times of at least ``spacing_s``."""
        return self._best(spacing_s)[0]._replace(inter_event_s=inter_event_s)

    def _best(self, spacing_s: float) -> tuple[Constants, float]:
        """Return the tighter constants of both bounds of e_c, and D_K's part of the present e_s."""
        error, events = self._error, self._missing(spacing_s)
        bounds = [_ErrorBound(
            {output: error.now(output) for output in error.outputs},
            {output: self._missing_gain(output, events, spacing_s) for output in error.outputs},
            self._missing_gain(Output.GAIN, events - self._conditions.dropouts, spacing_s),
            error.now(Output.GAIN),
        )]  # fmt: skip
        if self._conditions.delay_s > 0 and error.decays:
            bounds.append(self._drifting(spacing_s))
        found, void = [], VoidError("")
        for bound in bounds:
            try:
                found.append((self._constants(bound, events, spacing_s), bound.own))
            except VoidError as error_:
                void = min(void, error_, key=lambda one: one.loop_gain)
        if not found:
            raise void
        return min(found, key=lambda one: one[0].state)

    def _drifting(self, spacing_s: float) -> "_ErrorBound":
        """Return the bound of e_c by its value d ago, and by what has driven it since.

        d ago, e_c consisted of e_s and of the errors of events that are lost.
        """
        error, dropouts, kernels = self._error, self._conditions.dropouts, self._error.kernels
        return _ErrorBound(
            {output: kernel.sup() for output, kernel in kernels.items()},
            {output: error.missing(output, dropouts, spacing_s) for output in kernels},
            0.0,
            0.0,
            self._drift,
        )

    @cached_property
    def _drift(self) -> Mapping[Output, tuple[float, float, float]]:
        growths = self._plant.growths(self._conditions.delay_s, COARSE_CELLS)
        return {output: growth.totals for output, growth in growths.items()}

    def _constants(self, bound: "_ErrorBound", events: int, spacing_s: float) -> Constants:
        from_errors = self._from_errors(bound, spacing_s)
        signals = self._signals(bound, from_errors)
        loop_gain, solved = self._solved(signals)
        sensor_error = float(solved[1] + solved[2])
        state = dict(zip(self._states, signals.free + signals.states @ solved, strict=True))
        return Constants(
            self._error.alpha_per_s,
            events,
            float(signals.errors[Output.WEIGHTED] @ solved + solved[2]) / self.unit,
            sensor_error / self.unit,
            float(signals.errors[Output.GAIN] @ solved + solved[0]),
            self._start_error,
            float(state[Output.STATE]),
            float(state[Output.WEIGHTED]),
            float(state[Output.MISMATCH]),
            None,
            loop_gain,
            float(solved[2]),
            float(self._error.now(Output.GAIN) * solved[1] + solved[0]),
        )

    @property
    def unit(self) -> float:
        """The unit of Δ and β̃/β."""
        return self._bound.beta if self._bound.unit is None else self._bound.unit

    def _signals(self, bound: "_ErrorBound", from_errors: Mapping[str, float]) -> "_Signals":
        """Return how all outputs depend on (q, β̃, η, π, sup‖R_E x‖, 1).

        An event's x_s − x̂ is at most β̃ + η, the present x_s − x at most β̃.
        """
        free = np.array([state.free for state in self._states.values()])
        still = (0.0, 0.0, 0.0)
        by_input = np.array(bound.drift.get(Output.GAIN, still))
        present = bound.present[Output.GAIN]
        states = [
            (gain, from_errors[name], from_errors[name] - gain * present, *(gain * by_input))
            for name, (_, gain) in self._states.items()
        ]
        errors = {
            output: np.array([0.0, now + gone, gone, *bound.drift.get(output, still)])
            for (output, now), gone in zip(
                bound.present.items(), bound.missing.values(), strict=True
            )
        }
        return _Signals(list(self._states), free, np.array(states), errors)

    def _solved(self, signals: "_Signals") -> tuple[float, Vector]:
        """Return the loop gain and the bounds of the signals.

        Raises:
            VoidError: the loop gain is not below 1.
        """
        free, errors = signals.free, signals.errors
        hold_s = self._conditions.hold_s
        held: dict[str, float] = {
            Output.GAIN_RATE: hold_s,
            Output.GAIN_CURVATURE: hold_s**2 / 2,
            Output.WEIGHTED: self._remainder,
        }
        beyond = self._beyond
        held_input, _, estimated, *_ = np.eye(_SIGNALS)
        input_error = errors[Output.GAIN] + held_input

        through = signals.row(held)
        from_errors = sum(gain * errors[Output(output)] for output, gain in held.items())
        of_age = (through @ signals.states + from_errors, float(through @ free))
        estimation = self._estimation
        through = signals.row(estimation.shares)
        of_estimate = (
            through @ signals.states + estimation.from_input * input_error,
            estimation.fixed + float(through @ free) + estimation.from_input * beyond,
        )
        through = signals.row({Output.MISMATCH: 1.0})
        of_mismatch = (through @ signals.states, float(through @ free))
        others = ((input_error, beyond), of_mismatch, (0.0 * input_error, 1.0))

        def solved(growing: ErrorGrowth) -> Solution:
            through = signals.row(growing.shares)
            F = through @ signals.states + growing.input_error * input_error
            F += growing.estimation * estimated
            fixed = growing.fixed + through @ free + growing.input_error * beyond
            rows = (of_age, (F, fixed), of_estimate, *others)
            return solve_inequalities(*map(np.array, zip(*rows, strict=True)))

        # Of each bound one growth applies, and all bounds hold.
        found = [_largest([solved(one) for one in growths]) for growths in self._growths]
        gain = min(one.loop_gain for one in found)
        bounds = [one.bound for one in found if one.bound is not None]
        if not bounds:
            raise VoidError(f"the loop gain of the errors is {gain:.3g}, not below 1", gain)
        return gain, np.min(bounds, axis=0)

    def _missing_gain(self, output: Output, events: int, spacing_s: float) -> float:
        if self._error.decays or math.isinf(self._bound.due_s):
            return self._error.missing(output, events, spacing_s)
        return self._error.missing_until(output, events, self._bound.due_s)

    def _from_errors(self, bound: "_ErrorBound", spacing_s: float) -> Mapping[str, float]:
        """Return Γ_C for every output, from D_K and from the losses in windows.

        The second is computed only where it can be smaller: where all lost updates together have
        less effect than the longest burst at its largest.
        """
        present = bound.present[Output.GAIN] + bound.in_flight
        share = bound.present[Output.GAIN] + bound.missing[Output.GAIN]
        found = {output: gain * share for output, (_, gain) in self._states.items()}
        if self._lost is None:
            return found
        windows = self._conditions.guarantee.windows
        density = min(window.losses / window.packets for window in windows)
        lasting = density * self._error.kernels[Output.GAIN].integral()
        if not lasting < (share - present) * spacing_s:
            return found
        for output, (_, gain) in self._states.items():
            together = gain * present + self._lost.total(output, spacing_s, windows)
            found[output] = min(found[output], together)
        return found

    def inter_event_s(self, spacing_s: float) -> float:
        """Return the time that ‖e_s‖_W needs to the next event, given the spacing before it."""
        found, own = self._best(spacing_s)
        sensor_error = found.overshoot * self.unit - found.estimation_error
        others = found.input_error - own * sensor_error
        estimation = found.estimation_error
        # After an event e_s is the estimation error, and x_s − x̂ differs from e_s by one, too.
        passages_s = [
            first_passage_s(
                self._plant,
                one.reached - estimation,
                found.mismatch,
                max(others, self._beyond),
                own,
                estimation,
            )
            for one in self._bound.every
            if one.reached is not None
        ]
        limits_s = [one.ago_s or math.inf for one in self._bound.every if one.reached is not None]
        found_s = max(map(min, passages_s, limits_s))
        found_s = max(min(found_s, self._bound.due_s), self._bound.apart_s)
        grid_s = self._conditions.spacing_s
        return found_s if grid_s == 0 else grid_s * max(1, math.ceil(found_s / grid_s - 1e-9))

    def _missing(self, spacing_s: float) -> int:
        dropouts, delay_s = self._conditions.dropouts, self._conditions.delay_s
        if delay_s == 0:
            return dropouts
        if spacing_s == 0:
            raise VoidError("events may be arbitrarily close, so that any number may be under way")
        return dropouts + math.ceil(delay_s / spacing_s)


class _ErrorBound(NamedTuple):
    """sup‖C e_c‖ ≤ (present_C + missing_C) β̃ + drift_C · (π, sup‖R_E x‖, 1), for every output C."""

    present: Mapping[Output, float]
    """The gain of e_s, now or where the drift begins."""
    missing: Mapping[Output, float]
    """The gain of the events that are missing then."""
    in_flight: float
    """The part of missing_K that is not lost."""
    own: float
    """The part of present_K that is the e_s of now."""
    drift: Mapping[Output, tuple[float, float, float]] = MappingProxyType({})
    """The gains of what has driven e_c since then; none without a delay."""


class _Signals(NamedTuple):
    """The outputs of x and e_c as linear functions of (q, β̃, η, π, sup‖R_E x‖, 1).

    η = sup‖x̂ − x‖_W.
    """

    names: list[str]
    free: Vector
    """(k,) the constant part of sup‖C x‖."""
    states: Matrix
    """(k, 6)"""
    errors: Mapping[Output, Vector]
    """(6,) of sup‖C e_c‖."""

    def row(self, gains: Mapping[str, float]) -> Vector:
        """Return gains of the outputs, by name, as an array (k,)."""
        return np.array([gains.get(name, 0.0) for name in self.names])


def _largest(found: Sequence[Solution]) -> Solution:
    """Return the larger of several solutions; no bound if one has none."""
    bounds = [one.bound for one in found if one.bound is not None]
    gain = max(one.loop_gain for one in found)
    return Solution(gain, np.max(bounds, axis=0) if len(bounds) == len(found) else None)
