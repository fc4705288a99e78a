"""Constants of a schedule, sharpened by the flow from the moment an update acts to the next one.

Tests are sampled, updates act within d of their events, and inputs are held. From the moment an
update acts on, the plant's input is K x_c + q with ‖q‖ ≤ q̂, the part due to the age of the input.
So z = (x, e_c) follows the system of :mod:`noack.theory.certificates.delivery_flow`, with two
changes: e_c begins with what has entered within d, at most ``late``, and q drives z through
(BU, −BU). Both are bounded by the certificate's constants; what they change is added to every
bound. Each bound that becomes smaller is inserted into all others.
"""

from functools import cached_property

import numpy as np

from noack.core.linear_systems import spectral_abscissa
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
    errors_after_losses,
)
from noack.theory.certificates.inequalities import ErrorInequalities
from noack.theory.certificates.invariant_ellipsoids import InvariantEllipsoids

_ROUNDS, _SETTLED = 6, 0.98
_MOST_INSERTED, _NEARLY = 60, 0.9999


def is_scheduled_flow(part: Part, conditions: NetworkConditions) -> bool:
    """Return whether the constants of a loop without inputs can be sharpened."""
    error, plant, bound, estimation = part
    is_known = plant.is_one_plant and plant.forcing is None and estimation == MEASURED
    is_tested = bound.is_tested and not bound.ago_s  # of several bounds the first is used
    return (
        is_known
        and is_tested
        and conditions.spacing_s > 0
        and plant.alpha_per_s == error.alpha_per_s
        and spectral_abscissa(error.scaled_H) < 0
    )


def scheduled_constants(constants: Constants, part: Part, conditions: NetworkConditions) -> Constants:
    """Return the constants with the bounds from the flow between updates."""
    flow = _ScheduledFlow(part, conditions, constants.inter_event_s or conditions.spacing_s)
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
        part = part._replace(bound=part.bound._replace(also=()))
        self._part, self._conditions, self.spacing_s = part, conditions, spacing_s
        self._step = ErrorInequalities(part, conditions, 0.0)
        self.known = self._step.known(spacing_s)
        self._late_s = max(conditions.delay_s, conditions.start_s)

    @cached_property
    def _ellipsoids(self) -> InvariantEllipsoids:
        largest = self.known.errors[Output.WEIGHTED]
        return InvariantEllipsoids(self._part.plant, largest, self._step.age_gains)

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
        reach = self._ellipsoids.within(limit, self._disturbed, conditions.start_s)
        if reach is None:
            return False
        known.signals[0] = min(known.signals[0], reach.by.held)
        inverse = reach.size * self._part.plant.error.inverse_weight @ reach.starts.inverse
        for name, C in self._part.plant.outputs.items():
            known.states[name] = min(known.states[name], float(spectral_norm(C @ inverse)) * ROUNDING)
        gain = reach.starts.flow.gain
        size = max(reach.sup(np.hstack([0 * gain, gain])), float(spectral_norm(gain)) * reach.by.late)
        known.errors[Output.GAIN] = min(known.errors[Output.GAIN], size)
        if self.spacing_s >= self._late_s:  # no event happens before the last update has acted
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
        plain, bound = (1 + np.array(missing)) * known.sensor, self._part.bound
        level = bound.reached if bound.forced_s == np.inf else None  # a due event needs no e_s
        bend = 0.0 if level is None else bend_of_error(reach, level)
        kernel = error.kernels[Output.WEIGHTED]
        errors = errors_after_losses(reach, plain, known.sensor, level, self.spacing_s, kernel, bend)
        _, _, _, input_error, mismatch, *_ = known.signals.tolist()
        entered = self._entered(conditions.delay_s, input_error, mismatch)
        return error.stretch(conditions.delay_s) * float(errors[-1]) + entered
