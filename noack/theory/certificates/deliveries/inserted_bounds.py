"""The inequalities of one loop, into which bounds that hold are inserted to make them smaller.

The inequalities (:mod:`noack.theory.certificates.inequalities`) have one bound of e_s in each row,
so that they stay linear. Inserted bounds need not: for each error and output the smallest of all
bounds of e_s counts, and where e_s may have grown in two ways, from a test or from an event, the
larger one of them. Besides, e_c is followed in open loop.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import numpy as np

from noack.core.cached_method import cached_method
from noack.core.linear_systems import Matrix, Vector
from noack.theory.bounds.certificate_terms import NetworkConditions
from noack.theory.bounds.enclosure import response_until
from noack.theory.bounds.error_growth import COARSE_CELLS, ErrorGrowth
from noack.theory.bounds.gains import Growth, Output, PlantGains
from noack.theory.bounds.stacked_norms import Stack
from noack.theory.certificates.error_rows import BoundMethod, Signal
from noack.theory.certificates.inequalities import ErrorInequalities

Growths = Sequence[Sequence[ErrorGrowth]]
"""Growths of e_s that are possible under each bound of it. All bounds hold; of each, one growth applies."""


def _smallest(values: Matrix, growths: Growths) -> Matrix:
    """Return the smallest over all bounds of e_s of the largest over its growths, (o, g, …) → (o, …)."""
    ends = np.cumsum([0, *map(len, growths)])
    rows = [values[:, a:b].max(axis=1) for a, b in pairwise(ends)]
    return np.asarray(np.min(rows, axis=0))


class _SumOfErrors:
    """The gains of the errors of one loop, of events ``inter_event_s`` apart, of which ``count`` are missing.

    The present e_s is followed for ``later_s``, as if nothing reset it. Axes are named o, output; g,
    growth; i, the present error and those of the missing events, from the newest one on.
    """

    def __init__(
        self,
        plant: PlantGains,
        growths: Growths,
        begin_s: float,
        inter_event_s: float,
        count: int,
        later_s: float,
    ) -> None:
        error = plant.error
        all_growths = [growth for row in growths for growth in row]
        self._growths = growths
        self._begin_s = begin_s
        ages_s = inter_event_s * np.arange(count, dtype=np.float64)
        # Gains of the errors of missing events, and of what had entered before them.
        missing = np.array([error.kernels[C].sups(ages_s) for C in error.outputs])[:, None]
        kernels = [plant.driven[C] for C in error.outputs]
        sups = [np.array([kernel_pair[k].sups(ages_s) for kernel_pair in kernels])[:, None] for k in (0, 1)]
        grown = np.array([growth.driven[:2] for growth in all_growths])
        means_s = np.array([growth.mean_s for growth in all_growths])[:, None]
        # The same of the present error.
        present_gains = [error.now_until(later_s + growth.longest_s) for growth in all_growths]
        present = np.array([[gains[C] for gains in present_gains] for C in error.outputs])
        driven = np.zeros((2, len(kernels), len(all_growths)))
        for index, growth in enumerate(all_growths):
            if (until_s := later_s + growth.longest_s) > 0:
                followed = plant.growths(until_s, COARSE_CELLS)
                means = [followed[C].means(growth.ages_s + later_s)[:2] for C in error.outputs]
                driven[:, :, index] = np.array(means).T
        self._by_input, self._by_mismatch = (
            np.dstack([driven[k], np.minimum(missing * grown[:, k, None], means_s * sups[k])]) for k in (0, 1)
        )
        self._gains = np.dstack([present, np.broadcast_to(missing, (*present.shape, count))])
        """(o, g, i), like those of what has entered."""
        highest = np.array([kernel.sup() for kernel, _ in kernels])
        self._highest = highest[:, None]

    def bound(
        self, b: Vector, input_error: float, mismatch: float, start_error: float
    ) -> tuple[Matrix, Matrix]:
        """Bound each error's part of ‖C e_c‖, and what the first i of them had entered at first, (o, i).

        Given are bounds of ‖e_s‖_W after a test for each growth, of π and sup‖R_E x‖.
        """
        parts = self._parts(b, mismatch, np.array([input_error]))[..., 0]
        return parts, self._start_effects(self._begin_s) * max(start_error - input_error, 0.0)

    def after_losses(self, b: Vector, inputs: Vector, mismatch: float, late_s: float, late: float) -> Matrix:
        """Bound ‖C e_c‖ after 0, 1, … lost events, which are at least ``late_s`` apart, (o, j).

        ``inputs``: bounds of ‖p‖ meanwhile, and ``late`` until an update acts, for ``late_s``.
        """
        parts, lost = self._parts(b, mismatch, inputs), np.arange(len(inputs))
        sums = [parts[:, 0, j] + parts[:, lost[1 : j + 1], lost[:j][::-1]].sum(axis=1) for j in lost.tolist()]
        return np.array(sums).T + self._start_effects(late_s)[:, lost] * max(late - float(inputs[0]), 0.0)

    def _parts(self, b: Vector, mismatch: float, inputs: Vector) -> Stack:
        """Bound each error's part of ‖C e_c‖ for each bound of ‖p‖, (o, i, j)."""
        without_input = self._gains * b[:, None] + self._by_mismatch * mismatch
        return _smallest(without_input[..., None] + self._by_input[..., None] * inputs, self._growths)

    def _start_effects(self, late_s: float) -> Matrix:
        """Bound what enters within a time at first, into the first i errors together, by a p of 1, (o, i)."""
        return np.asarray(np.fmin(late_s * self._highest, self._by_input.max(axis=1).cumsum(axis=1)))


class _OpenLoopGains:
    """The gains of e_c, followed from the last test before each lost event in open loop.

    The input is computed from x_c, so e_c follows G − BK = H + αI − BK while no update acts. At
    the last test before an event it is e_s, at most b, and what is left of the lost errors. Axes
    are those of :class:`_SumOfErrors`.
    """

    def __init__(self, plant: PlantGains, growths: Growths) -> None:
        self._plant, self._growths = plant, [growth for row in growths for growth in row]

    @cached_method
    def _without_losses(self, later_s: float) -> Stack:
        """Return the gains of b, and of q and R_E x, then without means, (5, o, g)."""
        plant, error = self._plant, self._plant.error
        generator = error.scaled_H - plant.B @ error.K
        driven = np.hstack([plant.columns.input_error, plant.columns.mismatch])
        groups, any_age = (0, plant.columns.input_error.shape[1]), np.ones(1)
        gains_by_growth = []
        for growth in self._growths:
            ages_s = growth.ages_s + later_s
            until_s = float(ages_s.max())
            alone = response_until(generator, error.inverse_weight, until_s, COARSE_CELLS)
            pairs = response_until(generator, driven, until_s, COARSE_CELLS, groups=groups)
            kept_by_output = alone.through_each(error.stacked)
            entered = pairs.through_groups(error.stacked)
            rows = []
            for C in error.outputs:
                by_input, by_mismatch = entered[C]
                growth_sizes = Growth(by_mismatch, by_input, np.zeros(COARSE_CELLS))
                means = growth_sizes.means(ages_s if until_s else any_age)
                rows.append((kept_by_output[C].sup_on_grid(), *means[:2], *growth_sizes.totals[:2]))
            gains_by_growth.append(rows)
        return np.array(gains_by_growth).transpose(2, 1, 0)

    @cached_method
    def after(self, later_s: float, since_lost_s: float) -> Stack:
        """Return the gains of b, of a lost error, and of q and R_E x, then without means, (6, o, g).

        ``since_lost_s`` is the shortest time since the event of the lost error.
        """
        error = self._plant.error
        kept, *entered_by = self._without_losses(later_s)
        # A lost error has been followed by its model since, and by the open loop from then on.
        remaining_s = np.array([max(since_lost_s - growth.longest_s, 0.0) for growth in self._growths])
        remaining = {C: error.kernels[C].sups(remaining_s) for C in error.outputs}
        with_own_direction = np.array([*remaining.values()]) + entered_by[2] * remaining[Output.GAIN]
        of_lost = np.minimum(kept * remaining[Output.WEIGHTED], with_own_direction)
        return np.array([kept, of_lost, *entered_by])


class OpenLoopErrors:
    """Bounds of e_c in open loop, by :class:`_OpenLoopGains`, for events ``inter_event_s`` apart."""

    def __init__(
        self,
        plant: PlantGains,
        growths: Growths,
        gains: _OpenLoopGains,
        conditions: NetworkConditions,
        inter_event_s: float,
    ) -> None:
        self._growths, self._lost = growths, conditions.dropouts
        self._at_next_event = gains.after(0.0, inter_event_s)[:, :1]
        self._until_next_event = gains.after(0.0, 0.0)[:, :1]
        self._until_update_acts = gains.after(conditions.delay_s, 0.0)
        until_s = max(conditions.delay_s, conditions.start_s)
        self._entered_late = plant.growth(until_s, COARSE_CELLS).totals[:2] if until_s else (0.0, 0.0)

    def bound(
        self, b: Vector, age_input: float, input_error: float, mismatch: float
    ) -> tuple[Vector, Matrix]:
        """Bound ‖e_c‖_W after at most 0, 1, … lost events until the next event, (j,).

        The other result is sup‖C e_c‖ without a lost event, and after as many as there may be, (o, 2).
        ``age_input`` is q, and ``input_error`` bounds π before the first input, too.
        """
        by_input, by_mismatch = self._entered_late
        late = float(by_input * input_error + by_mismatch * mismatch)

        def open_loop_errors(gains: Stack, lost: float) -> Vector:
            kept, of_lost, by_input, by_mismatch, *totals = gains
            since_test = kept * b + of_lost * lost + by_input * age_input + by_mismatch * mismatch
            since_update = kept * late + totals[0] * age_input + totals[1] * mismatch
            return _smallest(np.maximum(since_test, since_update), self._growths)

        lost = [0.0]
        for _ in range(self._lost):
            lost.append(max(float(open_loop_errors(self._at_next_event, lost[-1])[0]), lost[-1]))
        between = np.array([open_loop_errors(self._until_next_event, error)[0] for error in lost])
        whole = [open_loop_errors(self._until_update_acts, error) for error in (0.0, lost[-1])]
        return between, np.array(whole).T


@dataclass
class KnownBounds:
    """Bounds of one loop that hold, each of which may be replaced by a smaller one."""

    signals: Vector
    """Of each :class:`Signal`."""
    states: dict[str, float]
    """Of sup‖C x‖."""
    errors: dict[Output, float]
    """Of sup‖C e_c‖."""
    sensor_error: float = math.inf
    """Of β̃ = sup‖e_s‖_W."""
    earlier_input_error: float = math.inf
    """Of the part of ‖u − Kx‖ that does not come from the present e_s."""
    received_input_error: float = math.inf
    """Of ‖u − Kx‖ while no event is missing."""
    present_input_error: float = math.inf
    """Of ‖K e_s‖ and the part of the age of the input together, whatever is missing."""
    after_losses: Vector = field(default_factory=lambda: np.array(math.inf))
    """Of ‖e_c‖_W after at most 0, 1, … lost events, from when an update acts until the next event."""
    sensor_after_losses: Vector = field(default_factory=lambda: np.array(math.inf))
    """Of ‖e_s‖_W meanwhile, if the update acts before the first lost event."""
    inputs_after_losses: Vector = field(default_factory=lambda: np.array(math.inf))
    """Of ‖p‖ likewise."""
    tested_sensor_error: float = math.inf
    """Of ‖e_s‖_W after a test."""

    def reduce_errors(self, bounds: Vector) -> None:
        """Take smaller bounds of sup‖C e_c‖, (o,)."""
        for output, bound in zip(self.errors, bounds.tolist(), strict=True):
            self.errors[output] = min(self.errors[output], bound)

    @property
    def input_error(self) -> float:
        """π."""
        return self.errors[Output.GAIN] + float(self.signals[Signal.AGE_INPUT])

    @property
    def driving(self) -> tuple[float, float, float]:
        """q, π and sup‖R_E x‖, which drive the errors."""
        age_input, input_error, mismatch = self.signals[
            [Signal.AGE_INPUT, Signal.INPUT_ERROR, Signal.MISMATCH]
        ].tolist()
        return age_input, input_error, mismatch


class InsertedInequalities(ErrorInequalities):
    """The inequalities of one loop without disturbances, into which bounds are inserted."""

    def solved_bounds(self, inter_event_s: float) -> KnownBounds:
        """Return the bounds of one loop; infinite without a certificate."""
        times_s, events = np.array([inter_event_s]), np.array([self._missing_events(inter_event_s)])
        solved = [
            solution.bound[0]
            for method in self.methods
            for _, solution in self._solutions(method, events, times_s)
        ]
        infinite = dict.fromkeys(self._states, math.inf), dict.fromkeys(self._error.outputs, math.inf)
        return KnownBounds(np.min(solved, axis=0), *infinite)

    def insert(self, bounds: KnownBounds, inter_event_s: float) -> None:
        """Insert bounds that hold into all inequalities of one loop, to make them smaller."""
        states, errors, (_, input_error, _) = bounds.states, bounds.errors, bounds.driving
        # x from the start on.
        for name, (free, forced) in self._timed_states.items():
            states[name] = min(states[name], float((free + forced * input_error).max()))
        # e_s after a test, for each way in which it may grow from there.
        growths = [growth for row in self._growths for growth in row]
        b = np.array([growth.after_test(states) for growth in growths])
        is_last = [growth.longest_s == self._conditions.sampling_s for growth in growths]
        bounds.tested_sensor_error = min([bounds.tested_sensor_error, *b[is_last].tolist()])
        self._insert_errors(bounds, b, inter_event_s)
        if inter_event_s >= self.acts_within_s:
            self._insert_lost(bounds, b, inter_event_s)
        self._insert_sensor(bounds, b)
        new_signals = bounds.signals.copy()
        new_signals[Signal.AGE_INPUT] = sum(
            gain * (states[C] + errors[C]) for C, gain in self.age_gains.items()
        )
        new_signals[Signal.ESTIMATION_ERROR] = 0.0
        new_signals[Signal.INPUT_ERROR] = bounds.input_error
        new_signals[Signal.MISMATCH] = states[Output.MISMATCH]
        bounds.signals = np.minimum(bounds.signals, new_signals)

    def _insert_errors(self, bounds: KnownBounds, b: Vector, inter_event_s: float) -> None:
        """Insert bounds of e_c, given those of e_s after a test: as a sum, and in open loop."""
        age_input, input_error, mismatch = bounds.driving
        weighted, gain = self._rows
        for method, sums in self._error_sums(inter_event_s).items():
            parts, at_start = sums.bound(b, input_error, mismatch, self.start_error)
            whole = parts.cumsum(axis=1) + at_start
            if method is BoundMethod.MISSING:
                bounds.earlier_input_error = min(
                    bounds.earlier_input_error, float(whole[gain, -1] - parts[gain, 0]) + age_input
                )
                bounds.present_input_error = min(
                    bounds.present_input_error, float(whole[gain, 0]) + age_input
                )
                bounds.received_input_error = min(bounds.received_input_error, bounds.present_input_error)
                bounds.after_losses = np.minimum(
                    bounds.after_losses, whole[weighted, : self._conditions.dropouts + 1]
                )
            bounds.reduce_errors(whole[:, -1])
        start_error = max(input_error, self.start_error)
        open_loop_errors = self._open_loop_errors(inter_event_s)
        between_events, whole = open_loop_errors.bound(b, age_input, start_error, mismatch)
        bounds.reduce_errors(whole[:, -1])
        bounds.received_input_error = min(bounds.received_input_error, float(whole[gain, 0]) + age_input)
        bounds.after_losses = np.minimum(bounds.after_losses, between_events)

    def _insert_lost(self, bounds: KnownBounds, b: Vector, inter_event_s: float) -> None:
        """Insert bounds of e_c after 0, 1, … lost events, if an update acts before the next event."""
        age_input, input_error, mismatch = bounds.driving
        weighted, gain = self._rows
        inputs = np.minimum(
            bounds.inputs_after_losses, self._error.now(Output.GAIN) * bounds.after_losses + age_input
        )
        inputs[0] = min(inputs[0], bounds.received_input_error)
        # While one more event is in flight, π bounds the input that drives the present error.
        stages = np.append(inputs, input_error)[: self._missing_events(inter_event_s) + 1]
        start_error = max(input_error, self.start_error)
        sums = self._error_sums(inter_event_s)[BoundMethod.MISSING]
        summed = sums.after_losses(b, stages, mismatch, self.acts_within_s, start_error)
        bounds.reduce_errors(summed[:, -1])
        bounds.after_losses = np.minimum(bounds.after_losses, summed[weighted, : len(inputs)])
        bounds.inputs_after_losses = np.minimum(inputs, summed[gain, : len(inputs)] + age_input)

    @property
    def _rows(self) -> tuple[int, int]:
        """The rows of ‖e_c‖_W and of ‖K e_c‖ among the outputs of e_c."""
        outputs = [*self._error.outputs]
        return outputs.index(Output.WEIGHTED), outputs.index(Output.GAIN)

    def _insert_sensor(self, bounds: KnownBounds, b: Vector) -> None:
        """Insert bounds of e_s, given those after a test."""
        _, input_error, mismatch = bounds.driving
        inputs = np.minimum(bounds.inputs_after_losses + np.zeros_like(bounds.after_losses), input_error)
        received = inputs[0] = min(float(inputs[0]), bounds.received_input_error)
        inputs = np.append(input_error, inputs)
        late = self.entered(self.acts_within_s, max(input_error, self.start_error), mismatch)
        after_test, by_bound = iter(b.tolist()), []
        for row in self._growths:
            errors = np.max(
                [self._largest_errors(growth, next(after_test), inputs, mismatch) for growth in row], axis=0
            )
            until_s = max(growth.longest_s for growth in row)
            # In this time after an update acts, e_s is what was there and what has entered since.
            after_update = self._error.stretch(until_s) * late + self.entered(until_s, received, mismatch)
            by_bound.append([errors[0], max(float(errors[1]), after_update), *errors[2:]])
        smallest = np.min(by_bound, axis=0)
        bounds.sensor_error = min(bounds.sensor_error, float(smallest[0]))
        bounds.sensor_after_losses = np.minimum(
            bounds.sensor_after_losses, np.minimum(smallest[1:], bounds.sensor_error)
        )
        bounds.after_losses[0] = min(bounds.after_losses[0], bounds.sensor_after_losses[0])

    def entered(self, until_s: float, input_error: float, mismatch: float) -> float:
        """Bound the e_s that enters within some time."""
        if until_s == 0:
            return 0.0
        by_input, by_mismatch, _ = self._plant.growth(until_s, COARSE_CELLS).totals
        return float(by_input * input_error + by_mismatch * mismatch)

    @property
    def acts_within_s(self) -> float:
        """The longest time until an update acts: after its event, or after the start for the first one."""
        return max(self._conditions.delay_s, self._conditions.start_s)

    @cached_property
    def _timed_states(self) -> Mapping[str, tuple[Vector, Vector]]:
        """Bounds of ‖C x‖ from the start, and of what a p of 1 has added, up to some times, (k,)."""
        plant, (_, at_start) = self._plant, self._plant.start_up(self._conditions.start_s)
        return {
            name: (
                np.append(free.highest, free.tail_highest) + at_start[name],
                forced.integral_until(np.append(free.edges_s[1:], forced.edges_s[-1] + 1.0)),
            )
            for (name, free), forced in zip(plant.free.items(), plant.forced.values(), strict=True)
        }

    def _largest_errors(self, growth: ErrorGrowth, b: float, inputs: Vector, mismatch: float) -> Vector:
        """Return how large e_s may become under one bound, given those of ‖p‖; the start is in the first."""
        by_input, by_mismatch, _ = growth.driven
        at_start = np.fmin(by_input, self._begin_s * growth.highest)
        errors = growth.stretch * b + by_input * inputs + by_mismatch * mismatch
        errors[0] += at_start * max(self.start_error - float(inputs[0]), 0.0)
        return np.asarray(errors)

    @cached_method
    def _error_sums(self, inter_event_s: float) -> Mapping[BoundMethod, _SumOfErrors]:
        conditions = self._conditions
        numbers = {
            BoundMethod.DRIFTING: (conditions.dropouts, conditions.delay_s),
            BoundMethod.MISSING: (self._missing_events(inter_event_s), 0.0),
        }
        return {
            method: _SumOfErrors(self._plant, self._growths, self._begin_s, inter_event_s, *numbers[method])
            for method in self.methods
        }

    @cached_method
    def _open_loop_errors(self, inter_event_s: float) -> OpenLoopErrors:
        gains = self._open_loop_gains
        return OpenLoopErrors(self._plant, self._growths, gains, self._conditions, inter_event_s)

    @cached_property
    def _open_loop_gains(self) -> _OpenLoopGains:
        return _OpenLoopGains(self._plant, self._growths)

    def _missing_events(self, inter_event_s: float) -> int:
        """Return how many events may be missing: lost, or in flight."""
        conditions = self._conditions
        in_flight = math.ceil(conditions.delay_s / inter_event_s) if conditions.delay_s > 0 else 0
        return conditions.dropouts + in_flight

    @property
    def start_error(self) -> float:
        """sup‖u − Kx‖ of one loop before the first input."""
        return float(self._first_input_error)

    def next_event_s(self, bounds: KnownBounds) -> float:
        """Return the time between two events that follows from bounds; 0 if there is none."""
        if all(bound.least_event_error is None for bound in self._bound.all_bounds):
            return 0.0
        times_s = self.inter_event_s(
            mismatch=np.array([bounds.signals[Signal.MISMATCH]]),
            earlier_input_error=np.array([bounds.earlier_input_error]),
            estimation_error=np.zeros(1),
            drifts=np.array([False]),
            searched=np.array([True]),
        )
        return float(times_s[0])
