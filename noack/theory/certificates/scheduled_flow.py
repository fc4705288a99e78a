"""Constants sharpened by the flow from the moment an update acts to the next one.

Tests may be sampled, updates act within d of their events, and inputs may be held. From the moment
an update acts on, the plant's input is K x_c + q with ‖q‖ ≤ q̂, the part due to the age of the input.
So z = (x, e_c) follows the system of :mod:`noack.theory.certificates.delivery_flow`, with two
changes: e_c begins with what has entered within d, at most ``late``, and q drives z through
(BU, −BU). Both are bounded by the certificate's constants; what they change is added to every
bound. Each bound that becomes smaller is inserted into all others.

The inequalities have one bound of e_s in each row, so that they stay linear. Inserted bounds need not:
for each error and output the smallest of all bounds of e_s counts, and where e_s may have grown in
two ways, from a test or from an event, the larger one of them. What entered before the i-th missing
event is bounded by π_i, the bound of ‖p‖ while at most i events are missing.

**The next event.** After an event e_s begins at 0. If updates act at once and no input is held, it
is C_r z(t_k) after r, C_r = (0, I) e^{Fr} − e^{(H+αI)r} (0, I), as long as no update is received.
At the event z(t_k) is (ξ, 0), or up to it ‖e_c‖_W ≤ D', since one event less is missing than may
be. So the next event comes later than certified without the flow, and D is smaller with this longer
time.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from noack.core.cached_method import cached_method
from noack.core.linear_systems import Matrix, Vector, spectral_abscissa
from noack.theory.bounds.contraction import spectral_norm
from noack.theory.bounds.enclosure import response
from noack.theory.bounds.gains import Output, PlantGains
from noack.theory.bounds.terms import MEASURED, Constants, NetworkConditions, Part
from noack.theory.bounds.trigger_bounds import COARSE_CELLS, ErrorGrowth
from noack.theory.certificates.delivery_flow import (
    ROUNDING,
    Disturbed,
    Reach,
    SensorErrors,
    Starts,
    bend_of_error,
    error_after,
    errors_after_losses,
)
from noack.theory.certificates.inequalities import MOST_STAGES, BoundMethod, ErrorInequalities, LoopConstants
from noack.theory.certificates.invariant_ellipsoids import InvariantEllipsoids

_ROUNDS, _SETTLED = 20, 0.99
_MOST_INSERTED, _NEARLY = 60, 0.9999
_SHORTEST_S, _LEAST_SHARE, _LEAST = 1e-9, 1e-6, 1e-200
_SHORT, _MOST_STEPS = 0.005, 16


def is_scheduled_flow(part: Part, conditions: NetworkConditions) -> bool:
    """Return whether the constants of a loop without inputs can be sharpened."""
    error, plant, bound, estimation = part
    is_known = plant.is_one_plant and plant.forcing is None and estimation == MEASURED
    return (
        is_known
        and bound.is_tested
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
        self._step = _Inserted(part, conditions, 0.0)
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
            for output, most in known.errors.items():
                known.errors[output] = min(most, size * self._part.plant.error.now(output))
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
        return Disturbed(held, self._step.entered(self._late_s, input_error, mismatch), self._late_s)

    def _after_losses(self, reach: Reach) -> float:
        """Bound ‖e_c‖_W after as many losses as there may be, until the next update acts."""
        known, error, conditions = self.known, self._part.plant.error, self._conditions
        errors = known.lost if self._errors is None else np.minimum(known.lost, self._errors)
        of_sensor = self._of_sensor
        level = 0.0 if of_sensor.integrates else of_sensor.level
        bend = bend_of_error(reach, level or float(of_sensor.sizes.max())) if of_sensor.level else 0.0
        if level and reach.by.is_none:
            at_event = max(float(errors_at_events(errors)[-1]), _LEAST_SHARE * reach.limit)
            at_events = replace(reach, limit=at_event)
            next_s = _next_event_s(at_events, level, self.spacing_s, bend)
            self.spacing_s = self._tested_s(next_s)
        kernel = error.kernels[Output.WEIGHTED]
        errors, apart_s = errors_after_losses(
            reach, errors, of_sensor, self._bounded, self.spacing_s, kernel, bend
        )
        self._errors = errors
        self.spacing_s = self._tested_s(apart_s)
        # An event comes after the first input has been applied.
        entered = self._step.entered(conditions.delay_s, *known.signals[3:5].tolist())
        later = error.stretch(conditions.delay_s) * errors + entered
        most = np.maximum(errors, errors_at_events(later))
        known.inputs_after_losses = error.now(Output.GAIN) * most + float(known.signals[0])
        return float(later[-1])

    @property
    def _bounded(self) -> list[Matrix]:
        """Matrices Y with ‖Y z‖ ≤ 1 at all times: the bounds of W x, E x and K e_c."""
        plant, known = self._part.plant, self.known
        gain, inverse = plant.error.split_K[1], plant.error.inverse_weight
        of_x = [plant.outputs[C] / max(known.states[C], _LEAST) for C in (Output.WEIGHTED, Output.MISMATCH)]
        rows = [np.hstack([C @ inverse, np.zeros((len(C), len(inverse)))]) for C in of_x]
        gain = gain @ inverse / max(known.errors[Output.GAIN], _LEAST)
        return [*rows, np.hstack([np.zeros_like(gain), gain])]

    @property
    def _of_sensor(self) -> SensorErrors:
        """What is known of e_s between two events."""
        known, bound, conditions = self.known, self._part.bound, self._conditions
        level, h_s = bound.reached or 0.0, conditions.sampling_s
        if bound.is_mean:  # of an integral, over any time
            level *= bound.ago_s
        if bound.forced_s < math.inf or (bound.ago_s and not bound.is_mean):
            level = 0.0  # an event may need no e_s
        tested = known.tested if h_s == conditions.spacing_s else math.inf
        begin_s = bound.untested_s + h_s if bound.untested_s else 0.0
        sizes = np.minimum(known.present, known.sensor)
        return SensorErrors(sizes, tested, begin_s, conditions.spacing_s, level, bound.is_mean)

    def _tested_s(self, time_s: float) -> float:
        """Round a time up to the tests."""
        grid_s = self._conditions.spacing_s
        return grid_s * math.ceil(time_s / grid_s - 1e-9) if grid_s else time_s


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


class _ErrorsByNumber:
    """The gains of the errors of one loop, of events ``spacing_s`` apart, of which ``count`` are missing.

    The present e_s is followed for ``later_s``, as if nothing reset it. ``growths``: how e_s may grow
    under each bound of it. Axes are named o, output; g, growth; m, newer missing events; i, older ones.
    """

    def __init__(
        self,
        plant: PlantGains,
        growths: Sequence[Sequence[ErrorGrowth]],
        delay_s: float,
        begin_s: float,
        spacing_s: float,
        count: int,
        later_s: float,
    ) -> None:
        error, each = plant.error, [growth for row in growths for growth in row]
        self.count = count
        ends = np.cumsum([0, *map(len, growths)]).tolist()
        self._spans = [*pairwise(ends)]
        self._is_staged = 0 < count <= MOST_STAGES
        numbers = np.arange(count + 1, dtype=np.float64)
        ages_s = spacing_s * numbers[:-1]
        self._gains = np.array([error.kernels[C].sups(ages_s) for C in error.outputs])
        """(o, m)"""
        kernels = [plant.driven[C] for C in error.outputs]
        by_input, mismatched = (np.array([pair[k].sups(ages_s) for pair in kernels]) for k in (0, 1))
        grown = np.array([growth.driven[:2] for growth in each])
        means_s, longest_s = np.array([(growth.mean_s, growth.longest_s) for growth in each]).T
        self._entered, self._mismatched = (
            np.minimum(self._gains[:, None] * grown[:, k, None], means_s[:, None] * sups[:, None])
            for k, sups in enumerate((by_input, mismatched))
        )
        """(o, g, m): of what enters before a missing event."""
        in_flight_s = np.maximum(delay_s - spacing_s * numbers, 0.0)
        late_s = np.minimum(in_flight_s[:-1], longest_s[:, None])
        late = late_s[:, None] * by_input[:, None, :, None]
        self._late = np.minimum(self._entered[..., None], late if self._is_staged else np.inf)
        """(o, g, m, i): the part that may have entered while an update was in flight."""
        now, highest = [error.now_until(later_s + g.longest_s) for g in each], [k.sup() for k, _ in kernels]
        self._now = np.array([[gains[C] for gains in now] for C in error.outputs])
        """(o, g)"""
        driven = np.zeros((len(kernels), len(each), 2))
        for place, growth in enumerate(each):
            if (until_s := later_s + growth.longest_s) > 0:
                followed = plant.growths(until_s, COARSE_CELLS)
                means = [followed[C].means(growth.ages_s + later_s)[:2] for C in error.outputs]
                driven[:, place] = means
        self._now_entered, self._now_mismatched = driven[..., 0], driven[..., 1]
        late = np.array(highest)[:, None, None] * in_flight_s
        self._now_late = np.minimum(self._now_entered[..., None], late if self._is_staged else np.inf)
        """(o, g, j)"""
        self._begun = np.fmin(
            begin_s * np.array(highest)[:, None],
            np.cumsum([self._now_entered.max(axis=1), *self._entered.max(axis=1).T], axis=0).T,
        )
        """(o, j): of what enters before the first input, beyond the bounds of later times."""

    def bound(
        self, b: Vector, inputs: Vector, input_error: float, mismatch: float, start_error: float
    ) -> tuple[Matrix, Matrix, Matrix, Matrix]:
        """Bound sup‖C e_c‖ while at most 0, 1, … events are missing, and its parts, (o, j).

        They are that of these events, with what enters before the first input, and that of e_s. The
        last result is that of e_s while no event is missing, for each bound of it, (row, o).

        Given are bounds of ‖e_s‖_W after a test for each growth, of π_i, π and sup‖R_E x‖.
        """
        stages = inputs if self._is_staged else np.array([input_error])
        i = stages[: max(len(stages) - 1, 1)]
        errors = self._gains[:, None] * b[:, None] + self._mismatched * mismatch
        errors = errors[..., None] + (self._entered[..., None] - self._late) * i + self._late * input_error
        errors = self._rows(errors).min(axis=0)
        now = self._now * b + self._now_mismatched * mismatch
        now = now[..., None] + (self._now_entered[..., None] - self._now_late) * stages
        rows = self._rows(now + self._now_late * input_error)
        count, last = errors.shape[1], errors.shape[2] - 1
        older = np.arange(count)
        missing = [
            errors[:, older[:number], np.minimum(number - 1 - older[:number], last)].sum(axis=1)
            for number in range(count + 1)
        ]
        alone = np.array(missing).T + self._begun * max(start_error - float(stages[0]), 0.0)
        present = np.broadcast_to(rows.min(axis=0), alone.shape)
        whole, alone = (np.maximum.accumulate(part, axis=1) for part in (present + alone, alone))
        return whole, alone, present, rows[:, :, 0]

    def _rows(self, values: Matrix) -> Matrix:
        """Return the largest over the growths of each bound of e_s, (row, o, …)."""
        return np.array([values[:, a:b].max(axis=1) for a, b in self._spans])


@dataclass
class _KnownBounds:
    """Bounds of one loop that hold, each of which may be replaced by a smaller one."""

    signals: Vector
    """Of (q, b, η, π, sup‖R_E x‖, 1), or β̃ for b."""
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
    lost: Vector = field(default_factory=lambda: np.array(math.inf))
    """Of ‖e_c‖_W while at most 0, 1, … events have been lost since the last one was received."""
    present: Vector = field(default_factory=lambda: np.array(math.inf))
    """Of ‖e_s‖_W meanwhile: from the first lost event on, the input is that of the controller."""
    tested: float = math.inf
    """Of ‖e_s‖_W after a test."""
    inputs: dict[BoundMethod, Vector] = field(default_factory=dict)
    """Of ‖p‖ while at most 0, 1, … events are missing."""
    inputs_after_losses: Vector = field(default_factory=lambda: np.array(math.inf))
    """The same from the flow between updates, up to the longest burst."""

    @property
    def input_error(self) -> float:
        """π."""
        return self.errors[Output.GAIN] + float(self.signals[0])


class _Inserted(ErrorInequalities):
    """The inequalities of one loop without disturbances, into which bounds are inserted."""

    def known(self, spacing_s: float) -> _KnownBounds:
        """Return the bounds of one loop; infinite without a certificate."""
        spacing, events = np.array([spacing_s]), np.array([self._missing_events(spacing_s)])
        solved = [
            bound[0] for method in self.methods for _, _, bound in self._solutions(method, events, spacing)
        ]
        infinite = dict.fromkeys(self._states, math.inf), dict.fromkeys(self._error.outputs, math.inf)
        return _KnownBounds(np.min(solved, axis=0), *infinite)

    def insert(self, known: _KnownBounds, spacing_s: float) -> None:
        """Insert bounds that hold into all inequalities of one loop, to make them smaller."""
        v, states, errors, h_s = known.signals, known.states, known.errors, self._conditions.sampling_s
        (held, input_error, mismatch), place = (
            v[[0, 3, 4]].tolist(),
            [*self._error.outputs].index(Output.GAIN),
        )
        for name, (free, gains) in self._rising.items():
            states[name] = min(states[name], float((free + gains * input_error).max()))
        growths = [growth for row in self._growths for growth in row]
        b = np.array([g.fixed + sum(share * states[C] for C, share in g.shares.items()) for g in growths])
        of_last = [one for g, one in zip(growths, b.tolist(), strict=True) if g.longest_s == h_s]
        known.tested = min([known.tested, *of_last])
        lost = np.arange(self._conditions.dropouts + 1)
        for method, by_number in self._by_number(spacing_s).items():
            inputs, before = np.full(by_number.count + 1, input_error), np.inf
            if len(known.inputs.get(method, ())) == len(inputs):
                inputs = np.minimum(inputs, known.inputs[method])
            if method is BoundMethod.MISSING:
                count = len(lost)
                inputs[:count] = np.minimum(inputs[:count], known.inputs_after_losses)
            while (inputs < _NEARLY * before).any():
                whole, missing, now, rows = by_number.bound(
                    b, inputs, input_error, mismatch, self.start_error
                )
                inputs, before = np.minimum(inputs, whole[place] + held), inputs
            known.inputs[method] = inputs
            for output, size in zip(self._error.outputs, whole[:, -1].tolist(), strict=True):
                errors[output] = min(errors[output], size)
            if method is BoundMethod.MISSING:
                known.earlier = min(known.earlier, float(missing[place, -1]) + held)
                known.received = min(known.received, float(whole[place, 0]) + held)
                own = [*self._error.outputs].index(Output.WEIGHTED)
                first = self._first_error(rows[:, own], float(inputs[0]), input_error, mismatch)
                found = np.append(min(first, whole[own, 0]), whole[own, lost[1:]])
                known.lost = np.minimum(known.lost, found)
                known.present = np.minimum(known.present, np.append(found[0], now[own, lost[1:]]))
        rows = iter(b.tolist())
        sizes = [max(self._grown(one, next(rows), *v[3:5]) for one in row) for row in self._growths]
        known.sensor = min(known.sensor, *sizes)
        age = sum(gain * (states[C] + errors[C]) for C, gain in self.age_gains.items())
        found_v = [age, v[1], 0.0, known.input_error, states[Output.MISMATCH], 1.0]
        known.signals = np.minimum(v, np.array(found_v, dtype=np.float64))

    @cached_property
    def _rising(self) -> Mapping[str, tuple[Vector, Vector]]:
        """For every output C x: what x(0) causes from times on, and gains of p until the next one."""
        plant, found = self._plant, {}
        begun = response(plant.closed_loop, plant.start).through_each(plant.stacked)
        for name, kernel in plant.forced.items():
            free = begun[name].sups(kernel.edges_s) + self._states[name].free - plant.states[name].free
            found[name] = free, np.append(np.cumsum(kernel.area), kernel.integral())
        return found

    def entered(self, until_s: float, input_error: float, mismatch: float) -> float:
        """Bound the e_s that enters within some time."""
        if until_s == 0:
            return 0.0
        by_input, mismatched, _ = self._plant.growth(until_s, COARSE_CELLS).totals
        return float(by_input * input_error + mismatched * mismatch)

    def _first_error(self, rows: Vector, received: float, input_error: float, mismatch: float) -> float:
        """Bound ‖e_s‖_W while no event is missing, from when an update acts on.

        ``rows``: each bound of it without the start, which holds after its own time.
        """
        late_s = max(self._conditions.delay_s, self._conditions.start_s)
        late = self.entered(late_s, max(input_error, self.start_error), mismatch)
        times_s = [max(growth.longest_s for growth in row) for row in self._growths]
        grown = [
            self._error.stretch(until_s) * late + self.entered(until_s, received, mismatch)
            for until_s in times_s
        ]
        return float(np.maximum(rows, grown).min())

    def _grown(self, growth: ErrorGrowth, b: float, input_error: float, mismatch: float) -> float:
        """Return how large e_s may become under one bound."""
        by_input, mismatched, _ = growth.driven
        begun = np.fmin(by_input, self._begin_s * growth.highest) * max(self.start_error - input_error, 0.0)
        return float(growth.stretch * b + by_input * input_error + mismatched * mismatch + begun)

    @cached_method
    def _by_number(self, spacing_s: float) -> Mapping[BoundMethod, _ErrorsByNumber]:
        conditions = self._conditions
        numbers = {
            BoundMethod.DRIFTING: (conditions.dropouts, conditions.delay_s),
            BoundMethod.MISSING: (self._missing_events(spacing_s), 0.0),
        }
        return {
            method: _ErrorsByNumber(
                self._plant,
                self._growths,
                conditions.delay_s,
                self._begin_s,
                spacing_s,
                *numbers[method],
            )
            for method in self.methods
        }

    def _missing_events(self, spacing_s: float) -> int:
        """Return how many events may be missing: lost, or in flight."""
        conditions = self._conditions
        flying = math.ceil(conditions.delay_s / spacing_s) if conditions.delay_s > 0 else 0
        return conditions.dropouts + flying

    @property
    def start_error(self) -> float:
        """sup‖u − Kx‖ of one loop before the first input."""
        return float(self._beyond)

    def next_event_s(self, known: _KnownBounds) -> float:
        """Return the time between two events that follows from bounds; 0 if there is none."""
        if all(bound.reached is None for bound in self._bound.every):
            return 0.0
        still, never = np.zeros(1), np.zeros(1, dtype=bool)
        events = np.zeros(1, dtype=np.int64)
        mismatch, earlier = known.signals[4:5], still + known.earlier
        before, after = (still,) * 6, (still,) * 3
        constants = LoopConstants(events, *before, mismatch, *after, earlier, ~never)
        return float(self.inter_event_s(constants, never, ~never)[0])
