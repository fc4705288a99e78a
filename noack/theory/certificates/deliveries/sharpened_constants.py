"""Constants sharpened by the flow from the moment an update acts to the next one.

Tests may be sampled, updates act within d of their events, and inputs may be held. From the moment
an update acts on, the plant's input is K x_c + q with ‖q‖ ≤ q̂, the part due to the age of the
input. So z = (x, e_c) follows the system of ``delivery_flow.py``, with two changes: e_c begins with
what has entered within d, at most ``first_error``, and q drives z through (BU, −BU). Both are
bounded by the certificate's constants; what they change is added to every bound. Each bound that
becomes smaller is inserted into all others.

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

from noack.core.linear_systems import Matrix, Vector, spectral_abscissa
from noack.theory.bounds.certificate_terms import MEASURED, CertificatePart, Constants, NetworkConditions
from noack.theory.bounds.gains import Output
from noack.theory.bounds.stacked_norms import spectral_norm
from noack.theory.certificates.deliveries.delivery_flow import FLOW_ROUNDING, InputEffects, error_since_event
from noack.theory.certificates.deliveries.delivery_reach import DeliveryEllipsoid, Reach
from noack.theory.certificates.deliveries.inserted_bounds import InsertedInequalities
from noack.theory.certificates.deliveries.invariant_ellipsoids import InvariantEllipsoids
from noack.theory.certificates.deliveries.lost_events import SensorErrors, bend_of_error, errors_after_losses
from noack.theory.certificates.error_rows import Signal

_MOST_ROUNDS, _SETTLED = 20, 0.99
"""Limit of the rounds; they end when no bound of x or e_c falls below this share of the last one."""
_MOST_INSERTIONS, _INSERTIONS_SETTLED = 60, 0.9999
"""The same of the insertions in a round."""
_MOST_MISSING = 100
"""With more missing events at once the constants are not sharpened: each is followed in every round."""
_SHORTEST_S = 1e-9
"""Shortest inter-event time with which lost events are followed: events are resolved to 1 ns."""
_LEAST_SHARE = 1e-6
"""Least bound of ‖e_c‖ at an event, as a share of D: where no event is lost it is 0, but D may not be."""
_LEAST_BOUND = 1e-200
"""Least bound by which an output is divided: a bound may be 0."""
_SHORTEST_STEP, _MOST_STEPS = 0.005, 16
"""Limits of the search for the next event: the shortest step as a share of the time, and the most steps.
Each step takes as long as a bound for one output."""


def can_be_sharpened(part: CertificatePart) -> bool:
    """Whether it is the part of one known plant, without disturbances and without an observer."""
    error, plant, bound, estimation = part
    is_known = plant.is_one_plant and plant.forcing is None and estimation == MEASURED
    return (
        is_known
        and bound.is_tested
        and plant.alpha_per_s == error.alpha_per_s
        and spectral_abscissa(error.scaled_H) < 0
    )


def sharpened_constants(
    constants: Constants, part: CertificatePart, conditions: NetworkConditions
) -> Constants:
    """Return the constants with the bounds from the flow between updates."""
    inter_event_s = constants.inter_event_s or conditions.spacing_s
    if (inter_event_s == 0 and conditions.delay_s > 0) or constants.missing_events > _MOST_MISSING:
        return constants
    sharpening = SharpenedBounds(part, conditions, inter_event_s)
    bounds = sharpening.bounds
    if not np.isfinite(bounds.signals).all():
        return constants
    sharpening.insert()
    # Each round's smaller bounds make the next one's smaller, until they hardly do.
    for _ in range(_MOST_ROUNDS):
        earlier = bounds.errors[Output.WEIGHTED], bounds.states[Output.WEIGHTED]
        if not sharpening.sharpen_by_flow():
            break
        later = bounds.errors[Output.WEIGHTED], bounds.states[Output.WEIGHTED]
        if all(new > _SETTLED * old for new, old in zip(later, earlier, strict=True)):
            break
    # A constant is never worse than without the sharpening.
    unit = part.bound.beta if part.bound.unit is None else part.bound.unit
    sharpened = {
        "delta": bounds.errors[Output.WEIGHTED] / unit,
        "overshoot": bounds.sensor_error / unit,
        "input_error": bounds.input_error,
        "state": bounds.states[Output.STATE],
        "state_weighted": bounds.states[Output.WEIGHTED],
        "mismatch": bounds.states[Output.MISMATCH],
        "received_input_error": bounds.received_input_error,
        "present_input_error": bounds.present_input_error,
    }
    smaller = {name: min(value, getattr(constants, name)) for name, value in sharpened.items()}
    later_s = constants.inter_event_s and max(sharpening.inter_event_s, constants.inter_event_s)
    return constants._replace(**smaller, inter_event_s=later_s)


class SharpenedBounds:
    """The bounds of one loop, made smaller in turns; δ is ``inter_event_s``."""

    def __init__(self, part: CertificatePart, conditions: NetworkConditions, inter_event_s: float) -> None:
        self._part, self._conditions, self.inter_event_s = part, conditions, inter_event_s
        self._inequalities = InsertedInequalities(part, conditions, 0.0)
        self.bounds = self._inequalities.solved_bounds(inter_event_s)
        self._acts_within_s = self._inequalities.acts_within_s

    @cached_property
    def _ellipsoids(self) -> InvariantEllipsoids:
        error_bound, bound = self.bounds.errors[Output.WEIGHTED], self._part.bound
        # An event that is due to an integral, or to a deadline, does not need this ‖e_s‖_W.
        needs_level = bound.window_s == 0 and math.isinf(bound.times.earliest_due_s)
        level = bound.least_event_error or 0.0 if self._is_ideal and needs_level else 0.0
        return InvariantEllipsoids(self._part.plant, error_bound, self._inequalities.age_gains, level)

    @property
    def _is_ideal(self) -> bool:
        return self._acts_within_s == 0 and self._conditions.hold_s == 0

    def insert(self) -> None:
        """Insert bounds into the inequalities until they have settled."""
        for _ in range(_MOST_INSERTIONS):
            previous = self.bounds.signals
            self._inequalities.insert(self.bounds, self.inter_event_s)
            if (self.bounds.signals >= _INSERTIONS_SETTLED * previous).all():
                break

    def sharpen_by_flow(self) -> bool:
        """Make bounds smaller by the flow; return whether there is an ellipsoid."""
        bounds, conditions = self.bounds, self._conditions
        error_bound = bounds.errors[Output.WEIGHTED]
        effects_of = None if self._is_ideal else self._input_effects
        reach = self._ellipsoids.reach_within(error_bound, effects_of, conditions.start_s)
        if reach is None:
            return False
        bounds.signals[Signal.AGE_INPUT] = min(bounds.signals[Signal.AGE_INPUT], reach.effects.age_input)
        inverse = self._part.plant.error.inverse_weight
        for name, C in self._part.plant.outputs.items():
            bounds.states[name] = min(bounds.states[name], reach.sup_state(C @ inverse))
        gain = reach.ellipsoid.flow.gain
        at_first = float(spectral_norm(gain)) * reach.effects.first_error
        input_error = max(reach.sup(np.hstack([0 * gain, gain])), at_first)
        bounds.errors[Output.GAIN] = min(bounds.errors[Output.GAIN], input_error)
        # Where an update acts before the next event.
        if self.inter_event_s >= max(self._acts_within_s, _SHORTEST_S):
            error = max(self._after_losses(reach), reach.effects.first_error)
            for output, bound in bounds.errors.items():
                bounds.errors[output] = min(bound, error * self._part.plant.error.now(output))
        self.insert()
        self.inter_event_s = max(self.inter_event_s, self._inequalities.next_event_s(bounds))
        self.insert()
        return True

    def _input_effects(self, ellipsoid: DeliveryEllipsoid, scale: float) -> InputEffects:
        """Return what delay and hold change as long as ‖Λx‖ ≤ c, ``scale``.

        x_c, from which the input is computed, is e^{(H+αI)τ} x of the event of the last update.
        """
        bounds, plant = self.bounds, self._part.plant
        known_age_input, _, known_mismatch = bounds.driving
        gains = self._inequalities.age_gains.items()
        age_input = sum(gain * ellipsoid.model_sups[C] for C, gain in gains) * scale
        age_input = min(known_age_input, age_input)
        input_error = max(bounds.errors[Output.GAIN] + age_input, self._inequalities.start_error)
        R_E = plant.outputs[Output.MISMATCH] @ plant.error.inverse_weight
        mismatch_in_ellipsoid = scale * float(spectral_norm(R_E @ ellipsoid.inverse)) * FLOW_ROUNDING
        mismatch = min(known_mismatch, mismatch_in_ellipsoid)
        return InputEffects(
            age_input,
            self._inequalities.entered(self._acts_within_s, input_error, mismatch),
            self._acts_within_s,
        )

    def _after_losses(self, reach: Reach) -> float:
        """Bound ‖e_c‖_W after as many losses as there may be, until the next update acts."""
        bounds, error, conditions = self.bounds, self._part.plant.error, self._conditions
        sensor = self._sensor_errors
        level = 0.0 if sensor.integrates else sensor.level
        bend = bend_of_error(reach, level or float(sensor.after_losses.max())) if sensor.level else 0.0
        if level and reach.effects.is_none:
            at_event = max(float(errors_at_events(bounds.after_losses)[-1]), _LEAST_SHARE * reach.error_bound)
            at_events = replace(reach, error_bound=at_event)
            later_s = _next_event_s(at_events, level, self.inter_event_s, bend)
            later_s = min(later_s, self._part.bound.times.earliest_due_s)
            self.inter_event_s = max(self.inter_event_s, self._next_test_s(later_s))
        bounds.after_losses, implied_s = errors_after_losses(
            reach, bounds.after_losses, sensor, self._unit_outputs, self.inter_event_s, bend
        )
        self.inter_event_s = self._next_test_s(implied_s)
        # An event comes after the first input has been applied.
        _, input_error, mismatch = bounds.driving
        entered = self._inequalities.entered(conditions.delay_s, input_error, mismatch)
        return error.stretch(conditions.delay_s) * float(bounds.after_losses[-1]) + entered

    @property
    def _unit_outputs(self) -> list[Matrix]:
        """Matrices Y with ‖Y z‖ ≤ 1 at all times: the bounds of W x, E x and K e_c."""
        plant, bounds = self._part.plant, self.bounds
        gain, inverse = plant.error.split_K[1], plant.error.inverse_weight
        names = Output.WEIGHTED, Output.MISMATCH
        of_x = [plant.outputs[name] / max(bounds.states[name], _LEAST_BOUND) for name in names]
        rows = [np.hstack([C @ inverse, np.zeros((len(C), len(inverse)))]) for C in of_x]
        gain = gain @ inverse / max(bounds.errors[Output.GAIN], _LEAST_BOUND)
        return [*rows, np.hstack([np.zeros_like(gain), gain])]

    @property
    def _sensor_errors(self) -> SensorErrors:
        """Bounds of e_s between two events."""
        bound, h_s = self._part.bound, self._conditions.sampling_s
        level, grid_s = bound.least_event_error or 0.0, self._conditions.spacing_s
        if bound.is_mean:  # of an integral, over any time
            level *= bound.window_s
        if bound.window_s and not bound.is_mean:
            level = 0.0  # an event may need no e_s
        return SensorErrors(
            after_losses=self.bounds.sensor_after_losses,
            after_test=self.bounds.tested_sensor_error if h_s == grid_s else math.inf,
            first_test_s=bound.untested_s + h_s if bound.untested_s else 0.0,
            grid_s=grid_s,
            level=level,
            integrates=bound.is_mean,
            earliest_due_s=bound.times.earliest_due_s,
        )

    def _next_test_s(self, time_s: float) -> float:
        """Round a time up to the tests."""
        grid_s = self._conditions.spacing_s
        return grid_s * math.ceil(time_s / grid_s - 1e-9) if grid_s else time_s


def errors_at_events(errors: Vector) -> Vector:
    """Bound ‖e_c‖_W at a delivery, and up to the first, second, … lost event: one less is missing then."""
    return np.append(0.0, errors[:-1])


def _next_event_s(at_events: Reach, level: float, least_s: float, bend: float) -> float:
    """Return a time before which ‖e_s‖_W cannot reach ``level`` after an event.

    It is at least ``least_s``, a time that is known already. Over a step s, e_s differs from its
    chord by at most s²/8 times a bound of its second derivative, ``bend``, which holds as long as
    ‖e_s‖_W is below the level.
    """
    flow, reached_s = at_events.ellipsoid.flow, least_s
    if not (0 < least_s < math.inf and 0 < bend < math.inf):
        return least_s
    error, evaluations = at_events.sup(error_since_event(flow, reached_s)), 0
    slope = error / reached_s
    while error < level:
        step_s = min(math.sqrt(4 * (level - error) / bend), reached_s)
        if slope * step_s > 0.99 * (level - error):
            step_s = 0.99 * (level - error) / slope
        while evaluations < _MOST_STEPS and step_s > _SHORTEST_STEP * reached_s:
            later, evaluations = at_events.sup(error_since_event(flow, reached_s + step_s)), evaluations + 1
            if max(error, later) + step_s**2 / 8 * bend < level:
                break
            step_s *= 0.6
        else:
            return reached_s
        slope = (later - error) / step_s
        reached_s, error = reached_s + step_s, later
    return reached_s
