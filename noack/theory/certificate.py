"""Tight certificates: guaranteed bounds of a loop, their conditions and their constants.

Assumptions: the trigger ‖e_s‖_W > βe^{−αt} is tested at least every h seconds, the network keeps
its guarantee about losses, and the input is held. With all signals scaled by e^{αt}:

    sup‖C e_c‖  ≤ (‖C W⁻¹‖ + Σ_{j<N} sup_{τ≥jδ} ‖C e^{(H+αI)τ} W⁻¹‖) β̃ = D_C β̃          (I1)
    sup‖C x‖    ≤ free_C + gain_C q + Γ_C β̃,   Γ_C ≤ gain_C D_K       (plant, input error p)
    q           ≤ σ (sup‖KH x‖ + D_KH β̃) + r(σ) (sup‖x‖_W + D_W β̃)    (input of age ≤ σ)
    π = sup‖p‖  ≤ D_K β̃ + q
    β̃ = sup‖e_s‖_W ≤ ḡβ + I_E sup‖R_E x‖ + I_B π                      (between two tests)

with at most N missing events: the longest burst of losses, and ⌈d/δ⌉ in flight. Γ_C is smaller if
few updates may be lost in a window (:mod:`noack.theory.loss_accumulation`). These inequalities are
linear in q and β̃ and hold on every [0, T]. So their solution bounds the run if the loop gain is
below 1. The minimum inter-event
time δ is the time that ‖e_s‖_W needs from 0 to β under these bounds. If an assumed δ gives a time
of at least δ, it holds by induction over the events; the largest such δ is used.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from noack.impairments.loss_guarantee import LongestBurst, LossGuarantee, LossRule
from noack.theory.gains import Coefficients, ErrorGains, Output, PlantGains
from noack.theory.loss_accumulation import LossAccumulation

_SHORTEST_S, _LONGEST_S = 1e-9, 1e6
_SETTLED = 1e-3
_ATTEMPTS = 200
_PICARD_ROUNDS = 8
_COARSE, _FINE = 64, 256


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
    """‖E x‖ ≤ mismatch · e^{−αt}: the rate at which the model deviates from the plant."""
    inter_event_s: float | None
    """δ, lower bound of the inter-event time; None if there is no such bound."""
    loop_gain: float
    """Loop gain of the errors (small-gain condition); below 1."""


class VoidError(ArithmeticError):
    """There is no certificate; the message has the reason."""


class Level(NamedTuple):
    """The trigger's threshold, scaled."""

    beta: float
    """β: after a test, ‖e_s‖_W ≤ β."""
    reached: float | None
    """The smallest ‖e_s‖_W at an event; None if it may be arbitrarily small."""


class Background(NamedTuple):
    """Bounds from an earlier phase of the run, which still have effects in this phase.

    An event of the earlier phase may still be missing in this phase. Two successive tests or events
    may be in different phases.
    """

    sensor_error: float = 0.0
    """Bound of β̃."""
    mismatch: float = 0.0
    """Bound of sup‖R_E x‖."""
    input_error: float = 0.0
    """Bound of sup‖p‖."""
    inter_event_s: float = _LONGEST_S
    """Bound of the inter-event time."""


_CLEAN = Background()


def solve(
    error: ErrorGains,
    plant: PlantGains,
    conditions: NetworkConditions,
    level: Level,
    background: Background = _CLEAN,
    *,
    structured: bool = True,
) -> Constants:
    """Return the constants that are certified for all times.

    ``structured``: at every time, p = u − Kx consists of the errors of the events and of the age of
    the input. Otherwise it is only known that its norm is at most π.

    Raises:
        VoidError: the loop gain is not below 1.
        NotDecayingError: a mode of the loop decays more slowly than the threshold.
    """
    step = _Step(error, plant, conditions, level, background)
    if structured and plant.is_one_plant:
        step.use_windows()
    if level.reached is None:
        return step.constants(conditions.spacing_s, None)
    spacing_s = background.inter_event_s
    for _ in range(_ATTEMPTS):
        if spacing_s <= conditions.spacing_s:
            break
        found_s = step.inter_event_s(spacing_s)
        if found_s >= spacing_s:
            return step.constants(spacing_s, spacing_s)
        # Iterate from above to the largest spacing that is consistent with itself.
        spacing_s = found_s if found_s < (1 - _SETTLED) * spacing_s else (1 - _SETTLED) * found_s
    return step.constants(conditions.spacing_s, conditions.spacing_s or None)


class _Step:
    """One iteration: all constants for an assumed spacing of events."""

    def __init__(
        self,
        error: ErrorGains,
        plant: PlantGains,
        conditions: NetworkConditions,
        level: Level,
        background: Background,
    ) -> None:
        self._error, self._plant = error, plant
        self._conditions, self._level, self._background = conditions, level, background
        self._lost: LossAccumulation | None = None
        self._remainder = error.hold_remainder(conditions.hold_s)
        self._start_error, start = plant.start_up(conditions.start_s)
        self._states = {
            output: Coefficients(free + start[output], gain)
            for output, (free, gain) in plant.states.items()
        }
        self._stretch = error.stretch(conditions.sampling_s)
        self._mismatch_growth, self._input_growth = 0.0, 0.0
        if conditions.sampling_s > 0:
            growth = plant.growth(conditions.sampling_s, _COARSE)
            self._mismatch_growth = growth.mismatch.integral_on_grid()
            self._input_growth = growth.input_error.integral_on_grid()

    def use_windows(self) -> None:
        """Use how many updates may be lost in a window, too."""
        self._lost = LossAccumulation(self._plant, self._conditions.delay_s)

    def constants(self, spacing_s: float, inter_event_s: float | None) -> Constants:
        """Return all constants, given inter-event times of at least ``spacing_s``."""
        events = self._missing(spacing_s)
        shares = {
            output: self._error.now(output) + self._error.missing(output, events, spacing_s)
            for output in self._error.outputs
        }
        hold_s, states = self._conditions.hold_s, self._states
        rate, weighted = states[Output.GAIN_RATE], states[Output.WEIGHTED]
        mismatch = states[Output.MISMATCH]
        from_errors = self._from_errors(events, spacing_s, shares[Output.GAIN])
        # q = own q + from_e_s β̃ + input_fixed,   β̃ = from_q q + echo β̃ + error_fixed
        own = hold_s * rate.gain + self._remainder * weighted.gain
        from_e_s = hold_s * (from_errors[Output.GAIN_RATE] + shares[Output.GAIN_RATE])
        from_e_s += self._remainder * (from_errors[Output.WEIGHTED] + shares[Output.WEIGHTED])
        input_fixed = hold_s * rate.free + self._remainder * weighted.free
        from_q = self._mismatch_growth * mismatch.gain + self._input_growth
        echo = self._mismatch_growth * from_errors[Output.MISMATCH]
        echo += self._input_growth * shares[Output.GAIN]
        error_fixed = max(
            self._stretch * self._level.beta
            + self._mismatch_growth * max(mismatch.free, self._background.mismatch)
            + self._input_growth * max(self._start_error, self._background.input_error),
            self._background.sensor_error,
        )
        margin = (1 - own) * (1 - echo) - from_e_s * from_q
        loop_gain = max(own, echo, 1 - margin)
        if not loop_gain < 1:
            raise VoidError(f"the loop gain of the errors is {loop_gain:.3g}, not below 1")
        held = (input_fixed * (1 - echo) + from_e_s * error_fixed) / margin
        sensor_error = ((1 - own) * error_fixed + from_q * input_fixed) / margin
        input_error = shares[Output.GAIN] * sensor_error + held
        state = {
            output: free + gain * held + from_errors[output] * sensor_error
            for output, (free, gain) in states.items()
        }
        return Constants(
            self._error.alpha_per_s,
            events,
            shares[Output.WEIGHTED] * sensor_error / self._level.beta,
            sensor_error / self._level.beta,
            input_error,
            self._start_error,
            state[Output.STATE],
            state[Output.WEIGHTED],
            state[Output.MISMATCH],
            inter_event_s,
            loop_gain,
        )

    def _from_errors(self, events: int, spacing_s: float, share: float) -> Mapping[Output, float]:
        """Return Γ_C for every output, from D_K, the ``share``, and from the losses in windows.

        The second is computed only where it can be smaller: where all lost updates together have
        less effect than the longest burst at its largest.
        """
        found = {output: gain * share for output, (_, gain) in self._states.items()}
        error, windows = self._error, self._conditions.guarantee.windows
        in_flight = events - self._conditions.dropouts
        present = error.now(Output.GAIN) + error.missing(Output.GAIN, in_flight, spacing_s)
        density = min(window.losses / window.packets for window in windows)
        lasting = density * error.kernels[Output.GAIN].integral()
        if self._lost is None or not lasting < (share - present) * spacing_s:
            return found
        for output, (_, gain) in self._states.items():
            together = gain * present + self._lost.total(output, spacing_s, windows)
            found[output] = min(found[output], together)
        return found

    def inter_event_s(self, spacing_s: float) -> float:
        """Return the time that ‖e_s‖_W needs to the next event, given the spacing before it."""
        found = self.constants(spacing_s, None)
        own = self._error.now(Output.GAIN)
        others = found.input_error - own * found.overshoot * self._level.beta
        assert self._level.reached is not None
        found_s = first_passage_s(
            self._plant,
            self._level.reached,
            max(found.mismatch, self._background.mismatch),
            max(others, self._start_error, self._background.input_error),
            own,
        )
        grid_s = self._conditions.spacing_s
        return found_s if grid_s == 0 else grid_s * max(1, math.ceil(found_s / grid_s - 1e-9))

    def _missing(self, spacing_s: float) -> int:
        dropouts, delay_s = self._conditions.dropouts, self._conditions.delay_s
        if delay_s == 0:
            return dropouts
        if spacing_s == 0:
            raise VoidError("events may be arbitrarily close, so that any number may be under way")
        return dropouts + math.ceil(delay_s / spacing_s)


def first_passage_s(
    plant: PlantGains, level: float, mismatch: float, input_error: float, own: float
) -> float:
    """Return a time before which ‖e_s‖_W, starting at 0, cannot reach ``level``.

    Let ρ(r) = sup_{s≤r} ‖e_s‖_W. The part of e_c that equals the present e_s is bounded by ρ:

        ρ(r) ≤ ∫₀^r ‖W e^{Hs} L_E‖ sup‖R_E x‖ + ‖W e^{Hs} B U‖ (π' + own · ρ(r−s)) ds

    This is iterated from ρ = ``level``; every iterate is a bound until the level is reached.

    ``level`` is ‖e_s‖_W at an event, ``mismatch`` sup‖R_E x‖, ``own`` ‖K W^{−1}‖, and
    ``input_error`` π', the input error without the effect of the present e_s.
    """
    window_s, cells = _first_window_s(plant, level, mismatch, input_error + own * level), _COARSE
    known_s = 0.0
    while True:
        growth = plant.growth(window_s, cells)
        fixed = np.cumsum(growth.mismatch.area * mismatch + growth.input_error.area * input_error)
        rho = np.full(cells, level)
        for _ in range(_PICARD_ROUNDS):
            echo = np.convolve(growth.input_error.area, rho)[:cells]
            rho = np.minimum(level, fixed + own * echo)
        crossed = np.flatnonzero(rho >= level)
        if len(crossed):
            known_s = max(known_s, float(growth.mismatch.edges_s[crossed[0]]))
            if cells == _FINE:
                return known_s
            window_s, cells = float(growth.mismatch.edges_s[crossed[0] + 1]), _FINE
        elif window_s >= _LONGEST_S:
            return window_s
        else:  # not reached, also after a coarse grid's overestimate: extend the window
            known_s, window_s = window_s, 2 * window_s


def _first_window_s(plant: PlantGains, level: float, mismatch: float, input_error: float) -> float:
    """Return the first search window: twice the time to ``level`` at the initial speed, limited."""
    start = plant.growth(_SHORTEST_S, 1)
    speed = start.mismatch.sup_on_grid() * mismatch + start.input_error.sup_on_grid() * input_error
    if not speed > 0:
        return _LONGEST_S
    return min(max(2 * level / speed, _SHORTEST_S), _LONGEST_S)
