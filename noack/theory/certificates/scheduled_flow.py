"""Constants sharpened by the flow from the moment an update acts to the next one.

Tests may be sampled, updates act within d of their events, and inputs may be held. From the moment
an update acts on, the plant's input is K x_c + q with ‖q‖ ≤ q̂, the part due to the age of the input.
So z = (x, e_c) follows the system of :mod:`noack.theory.certificates.delivery_flow`, with two
changes: e_c begins with what has entered within d, at most ``late``, and q drives z through
(BU, −BU). Both are bounded by the certificate's constants; what they change is added to every
bound. Each bound that becomes smaller is inserted into all others.

**The next event.** After an event e_s begins at 0. If updates act at once and no input is held, it
is C_r z(t_k) after r, C_r = (0, I) e^{Fr} − e^{(H+αI)r} (0, I), as long as no update is received.
At the event z(t_k) is (ξ, 0), or up to it ‖e_c‖_W ≤ D', since one event less is missing than may
be. So the next event comes later than certified without the flow, and D is smaller with this longer
time.
"""

import math
from dataclasses import replace
from functools import cached_property

import numpy as np

from noack.core.linear_systems import Vector, spectral_abscissa
from noack.theory.bounds.contraction import spectral_norm
from noack.theory.bounds.gains import Output
from noack.theory.bounds.terms import MEASURED, Constants, NetworkConditions, Part
from noack.theory.bounds.trigger_bounds import COARSE_CELLS
from noack.theory.certificates.delivery_flow import (
    ROUNDING,
    Disturbed,
    Reach,
    Starts,
    bend_of_error,
    error_after,
    errors_after_losses,
)
from noack.theory.certificates.inequalities import ErrorInequalities
from noack.theory.certificates.invariant_ellipsoids import InvariantEllipsoids

_ROUNDS, _SETTLED = 20, 0.99
_MOST_INSERTED, _NEARLY = 60, 0.9999
_SHORTEST_S, _LEAST_SHARE = 1e-9, 1e-6
_SHORT, _MOST_STEPS = 0.005, 16


def is_scheduled_flow(part: Part, conditions: NetworkConditions) -> bool:
    """Return whether the constants of a loop without inputs can be sharpened."""
    error, plant, bound, estimation = part
    is_known = plant.is_one_plant and plant.forcing is None and estimation == MEASURED
    is_tested = bound.is_tested and not bound.also and not bound.ago_s
    return (
        is_known
        and is_tested
        and plant.alpha_per_s == error.alpha_per_s
        and spectral_abscissa(error.scaled_H) < 0
    )


def scheduled_constants(constants: Constants, part: Part, conditions: NetworkConditions) -> Constants:
    """Return the constants with the bounds from the flow between updates."""
    spacing_s = constants.inter_event_s or conditions.spacing_s
    if spacing_s == 0 and conditions.delay_s > 0:
        return constants
    flow = _ScheduledFlow(part, conditions, spacing_s)
    known = flow.known
    if not np.isfinite(known.signals).all():
        return constants
    flow.insert()
    for _ in range(_ROUNDS):
        before = known.errors[Output.WEIGHTED], known.states[Output.WEIGHTED]
        if not flow.follow():
            break
        after = known.errors[Output.WEIGHTED], known.states[Output.WEIGHTED]
        if all(new > _SETTLED * old for new, old in zip(after, before, strict=True)):
            break
    unit = part.bound.beta if part.bound.unit is None else part.bound.unit
    found = {
        "delta": known.errors[Output.WEIGHTED] / unit,
        "overshoot": known.sensor / unit,
        "input_error": known.input_error,
        "state": known.states[Output.STATE],
        "state_weighted": known.states[Output.WEIGHTED],
        "mismatch": known.states[Output.MISMATCH],
        "received_input_error": known.received,
    }
    smaller = {name: min(value, getattr(constants, name)) for name, value in found.items()}
    later_s = constants.inter_event_s and max(flow.spacing_s, constants.inter_event_s)
    return constants._replace(**smaller, inter_event_s=later_s)


class _ScheduledFlow:
    """The bounds of one loop, made smaller in turns; events are ``spacing_s`` apart."""

    def __init__(self, part: Part, conditions: NetworkConditions, spacing_s: float) -> None:
        self._part, self._conditions, self.spacing_s = part, conditions, spacing_s
        self._step = ErrorInequalities(part, conditions, 0.0)
        self.known = self._step.known(spacing_s)
        self._late_s = max(conditions.delay_s, conditions.start_s)
        self._errors: Vector | None = None
        """Bounds of ‖e_c‖_W at events while at most 0, 1, … have been lost."""

    @cached_property
    def _ellipsoids(self) -> InvariantEllipsoids:
        largest = self.known.errors[Output.WEIGHTED]
        level = self._part.bound.reached or 0.0 if self._is_ideal else 0.0
        return InvariantEllipsoids(self._part.plant, largest, self._step.age_gains, level)

    @property
    def _is_ideal(self) -> bool:
        return self._late_s == 0 and self._conditions.hold_s == 0

    def insert(self) -> None:
        """Insert bounds into the inequalities until they have settled."""
        for _ in range(_MOST_INSERTED):
            before = self.known.signals
            self._step.insert(self.known, self.spacing_s)
            if (self.known.signals >= _NEARLY * before).all():
                break

    def follow(self) -> bool:
        """Make bounds smaller by the flow; return whether there is an ellipsoid."""
        known, conditions = self.known, self._conditions
        limit = known.errors[Output.WEIGHTED]
        disturbed = None if self._is_ideal else self._disturbed
        reach = self._ellipsoids.within(limit, disturbed, conditions.start_s)
        if reach is None:
            return False
        known.signals[0] = min(known.signals[0], reach.by.held)
        inverse = self._part.plant.error.inverse_weight
        for name, C in self._part.plant.outputs.items():
            known.states[name] = min(known.states[name], reach.sup_state(C @ inverse))
        gain = reach.starts.flow.gain
        size = max(reach.sup(np.hstack([0 * gain, gain])), float(spectral_norm(gain)) * reach.by.late)
        known.errors[Output.GAIN] = min(known.errors[Output.GAIN], size)
        if self.spacing_s >= max(self._late_s, _SHORTEST_S):  # before, the last update has acted
            size = max(self._after_losses(reach), reach.by.late)
            known.errors[Output.WEIGHTED] = min(limit, size)
        self.insert()
        self.spacing_s = max(self.spacing_s, self._step.next_event_s(known))
        self.insert()
        return True

    def _disturbed(self, starts: Starts, size: float) -> Disturbed:
        """Return what delay and hold change as long as ‖ΛWx‖ ≤ c, ``size``.

        x_c, from which the input is computed, is e^{(H+αI)τ} x of the event of the last update.
        """
        known, plant = self.known, self._part.plant
        gains = self._step.age_gains.items()
        held = sum(gain * starts.model_sups[C] for C, gain in gains) * size
        held = min(float(known.signals[0]), held)
        input_error = max(known.errors[Output.GAIN] + held, self._step.start_error)
        R_E = plant.outputs[Output.MISMATCH] @ plant.error.inverse_weight
        of_mismatch = size * float(spectral_norm(R_E @ starts.inverse)) * ROUNDING
        mismatch = min(float(known.signals[4]), of_mismatch)
        return Disturbed(held, self._entered(self._late_s, input_error, mismatch), self._late_s)

    def _entered(self, until_s: float, input_error: float, mismatch: float) -> float:
        """Bound the e_s that enters within some time."""
        if until_s == 0:
            return 0.0
        by_input, mismatched, _ = self._part.plant.growth(until_s, COARSE_CELLS).totals
        return float(by_input * input_error + mismatched * mismatch)

    def _after_losses(self, reach: Reach) -> float:
        """Bound ‖e_c‖_W after as many losses as there may be, until the next update acts."""
        known, error, conditions = self.known, self._part.plant.error, self._conditions
        missing = [
            float(error.missing(Output.WEIGHTED, lost, self.spacing_s))
            for lost in range(conditions.dropouts + 1)
        ]
        plain, level = (1 + np.array(missing)) * known.sensor, self._part.bound.reached
        errors = plain if self._errors is None else np.minimum(plain, self._errors)
        bend = 0.0 if level is None else bend_of_error(reach, level)
        if level is not None and reach.by.is_none:
            at_event = max(float(errors_at_events(errors)[-1]), _LEAST_SHARE * reach.limit)
            at_events = replace(reach, limit=at_event)
            next_s, grid_s = _next_event_s(at_events, level, self.spacing_s, bend), conditions.spacing_s
            self.spacing_s = grid_s * math.ceil(next_s / grid_s - 1e-9) if grid_s else next_s
        kernel = error.kernels[Output.WEIGHTED]
        errors = errors_after_losses(reach, errors, known.sensor, level, self.spacing_s, kernel, bend)
        self._errors = errors
        _, _, _, input_error, mismatch, _ = known.signals.tolist()
        entered = self._entered(conditions.delay_s, input_error, mismatch)
        return error.stretch(conditions.delay_s) * float(errors[-1]) + entered


def errors_at_events(errors: Vector) -> Vector:
    """Bound ‖e_c‖_W after each event: 0 if it is received; a lost one was not missing before."""
    return np.append(0.0, errors[:-1])


def _next_event_s(at_events: Reach, level: float, known_s: float, bend: float) -> float:
    """Return a time before which ‖e_s‖_W cannot reach ``level`` after an event.

    It is at least the known one. Over a step s, e_s differs from its chord by at most s²/8 times a
    bound of its second derivative, which holds as long as ‖e_s‖_W is below the level.
    """
    flow, found_s = at_events.starts.flow, known_s
    if not (0 < known_s < math.inf and 0 < bend < math.inf):
        return known_s
    size, tries = at_events.sup(error_after(flow, found_s)), 0
    slope = size / found_s
    while size < level:
        step_s = min(math.sqrt(4 * (level - size) / bend), found_s)
        if slope * step_s > 0.99 * (level - size):
            step_s = 0.99 * (level - size) / slope
        while tries < _MOST_STEPS and step_s > _SHORT * found_s:
            later, tries = at_events.sup(error_after(flow, found_s + step_s)), tries + 1
            if max(size, later) + step_s**2 / 8 * bend < level:
                break
            step_s *= 0.6
        else:
            return found_s
        slope = (later - size) / step_s
        found_s, size = found_s + step_s, later
    return found_s
