"""How the errors of a loop depend on the signals v of its inequalities: as rows of v.

(I1) bounds ‖C e_s‖ and ‖C e_c‖ by numbers that are not negative, times the signals (see
:mod:`noack.theory.certificates.inequalities`). :class:`ErrorRows` returns these numbers, for assumed
inter-event times and missing events.
"""

import math
from collections.abc import Mapping, Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix, Vector
from noack.theory.bounds.certificate_terms import CertificatePart, NetworkConditions
from noack.theory.bounds.error_growth import COARSE_CELLS, ErrorGrowth
from noack.theory.bounds.gains import Output, sum_of_sups


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


UNIT_ROWS = np.eye(len(Signal))
"""For each signal the row that selects it."""
MOST_STAGES = 16
"""With more missing events π is used for all of them."""


class ErrorRows:
    """The rows of one part's errors.

    Args:
        part: the part.
        conditions: those of the network.
        first_input_error: bound of ‖p‖ before the first input.
        begin_s: time of the first input; infinite if the first inputs at a set-point are applied before.
        drifts: whether e_c is bounded by its value d ago, and by what has driven it since; otherwise by
            e_s and by the errors of all missing events. Bounds of parts may be added only if all are
            of the same of these two kinds.
    """

    def __init__(
        self,
        part: CertificatePart,
        conditions: NetworkConditions,
        first_input_error: float,
        begin_s: float,
        *,
        drifts: bool,
    ) -> None:
        self._error, self._plant, bound, _ = part
        self._longest_s = bound.times.longest_s
        self._conditions = conditions
        self._first_input_error, self._begin_s, self._drifts = first_input_error, begin_s, drifts

    def signals(self, events: int, inter_event_s: float, own_growth: ErrorGrowth | None) -> "SignalRows":
        """Return how all outputs depend on v.

        Every ‖e_s‖_W has grown by ``own_growth`` from at most b at the last test; without it b is β̃. An
        event's x_s − x̂ is at most this plus η, the present x_s − x is at most this.
        """
        sensor = UNIT_ROWS[Signal.AFTER_TEST]
        if own_growth is not None:
            sensor = self.with_start(
                signal_row(own_growth.stretch, 0.0, own_growth.driven), own_growth.highest
            )
        later_s = 0.0
        if self._drifts:  # d ago, e_c consisted of e_s and of the errors of events that are lost
            events, later_s = self._conditions.dropouts, self._conditions.delay_s
        present = {output: self._present(output, own_growth, later_s) for output in self._error.outputs}
        stages = self._stages(present[Output.GAIN], events, inter_event_s, own_growth)
        missing = {
            output: self._with_missing(output, row, events, inter_event_s, own_growth, stages)
            for output, row in present.items()
        }
        at_present = self._present(Output.GAIN, own_growth)
        received = self._with_missing(Output.GAIN, at_present, 0, inter_event_s, own_growth)
        earlier = missing[Output.GAIN]
        if not self._drifts:
            nothing = np.zeros(len(Signal))
            earlier = self._with_missing(Output.GAIN, nothing, events, inter_event_s, own_growth, stages)
        return SignalRows(missing, sensor, received, earlier)

    def _present(self, output: Output, own_growth: ErrorGrowth | None, later_s: float = 0.0) -> Vector:
        """Return the bound of sup‖C e_s‖ as a row of the signals.

        It is that of what e_s becomes, if nothing resets it, up to ``later_s`` after.
        """
        until_s = later_s + (0.0 if own_growth is None else own_growth.longest_s)
        driven = (0.0, 0.0, 0.0)
        if until_s > 0:
            growth = self._plant.growths(until_s, COARSE_CELLS)[output]
            driven = growth.totals if own_growth is None else growth.means(own_growth.ages_s + later_s)
        return signal_row(self._error.now_until(until_s)[output], 0.0, driven)

    def _with_missing(
        self,
        output: Output,
        present: Vector,
        events: int,
        inter_event_s: float,
        own_growth: ErrorGrowth | None,
        stages: "_Stages | None" = None,
    ) -> Vector:
        """Return the bound of sup‖C e_c‖ as a row of the signals, given that of e_s, ``present``.

        The part of e_s that has grown since the last test is followed from where it entered.
        """
        gain = self._missing_gain(output, events, inter_event_s)
        driven = [0.0] * 3 if own_growth is None else [gain * size for size in own_growth.driven]
        if own_growth is not None and own_growth.longest_s > 0:
            for index, kernel in enumerate(self._plant.driven[output]):
                followed = own_growth.mean_s * float(sum_of_sups(kernel, events, inter_event_s))
                driven[index] = min(driven[index], followed)
        highest = float(self._plant.driven[output][0].sup()) if self._error.decays else 0.0
        row = self.with_start(present + signal_row(gain, gain, driven), highest)
        if stages is not None and own_growth is not None:
            row[Signal.INPUT_ERROR] = present[Signal.INPUT_ERROR]
            effects = self._input_effects(output, len(stages.inputs), inter_event_s, own_growth)
            row += stages.entered(*effects, events)
        return row

    def with_start(self, row: Vector, highest: float) -> Vector:
        """Add what enters before the first input, where ‖p‖ is not bounded by π.

        ``highest`` bounds what a p of 1 adds in a unit of time.
        """
        by_first_input = row[Signal.INPUT_ERROR]
        if not (highest == 0 and math.isinf(self._begin_s)):
            by_first_input = min(by_first_input, self._begin_s * highest)
        return np.asarray(row + self._first_input_error * by_first_input * UNIT_ROWS[Signal.ONE])

    def _input_effects(
        self, output: Output, count: int, inter_event_s: float, own_growth: ErrorGrowth
    ) -> tuple[Vector, Vector]:
        """Bound how inputs before missing events move C e_c, from the newest event on.

        Returns:
            Of the inputs since the test before the event, for ‖p‖ ≤ 1, and of those of one second,
            (count,) each.
        """
        ages_s = inter_event_s * np.arange(count, dtype=np.float64)
        sups = np.broadcast_to(self._plant.driven[output][0].sups(ages_s), ages_s.shape)
        gains = self._error.kernels[output].sups(ages_s)
        return np.minimum(gains * own_growth.driven[0], own_growth.mean_s * sups), sups

    def _stages(
        self, present: Vector, events: int, inter_event_s: float, own_growth: ErrorGrowth | None
    ) -> "_Stages | None":
        """Bound ‖p‖ while at most 0, 1, … events are missing; None where π is used instead.

        p since the test before a missing event was caused by fewer missing events, except before an
        update that was received has taken effect. ``present`` is the part of sup‖K e_c‖ that is not
        from missing events.
        """
        if own_growth is None or own_growth.longest_s == 0 or inter_event_s == 0:
            return None
        if not 0 < events <= MOST_STAGES:
            return None
        sizes, sups = self._input_effects(Output.GAIN, events, inter_event_s, own_growth)
        left_s = np.maximum(self._conditions.delay_s - inter_event_s * np.arange(events), 0.0)
        stages = _Stages(np.zeros((0, len(Signal))), np.minimum(left_s, own_growth.longest_s))
        highest = float(self._plant.driven[Output.GAIN][0].sup())
        by_input = present[Signal.INPUT_ERROR]
        for number in range(events):
            row = self._with_missing(Output.GAIN, present, number, inter_event_s, own_growth)
            row += UNIT_ROWS[Signal.AGE_INPUT]
            # The share of π from updates that act late.
            row[Signal.INPUT_ERROR] = before_update = min(by_input, highest * left_s[number])
            row += stages.entered(sizes, sups, number)
            # π where its own share is 1 or more.
            share_left = 1 - (by_input - before_update)
            row = row / share_left if share_left > 0 else UNIT_ROWS[Signal.INPUT_ERROR]
            stages = stages._replace(inputs=np.vstack([stages.inputs, row]))
        return stages

    def _missing_gain(self, output: Output, events: int, inter_event_s: float) -> float:
        if self._error.decays or math.isinf(self._longest_s):
            return float(self._error.missing(output, events, inter_event_s))
        return self._error.missing_until(output, events, self._longest_s)


class _Stages(NamedTuple):
    """Bounds of ‖p‖ while few events are missing."""

    inputs: Matrix
    """Rows of the signals, while 0, 1, … events are missing, (count, 6)."""
    late_s: Vector
    """For how long after the test before the first, second, … missing event an earlier update may
    not have taken effect yet."""

    def entered(self, sizes: Vector, sups: Vector, events: int) -> Vector:
        """Bound what has entered e_c before up to ``events`` missing events, (6,).

        ``sizes`` and ``sups`` are those of :meth:`ErrorRows._input_effects`.
        """
        largest = np.zeros(len(Signal))
        for count in range(1, min(len(self.inputs), events) + 1):
            late = np.minimum(sizes[:count], self.late_s[count - 1 :: -1] * sups[:count])
            row = (sizes[:count] - late) @ self.inputs[count - 1 :: -1]
            row[Signal.INPUT_ERROR] += late.sum()
            largest = np.maximum(largest, row)
        return largest


class SignalRows(NamedTuple):
    """The errors as linear functions of the signals: rows, (6,)."""

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
        return np.asarray(self.errors[Output.GAIN] + UNIT_ROWS[Signal.AGE_INPUT])


def signal_row(after_test: float, estimation_error: float, driven: Sequence[float]) -> Vector:
    """Return a row of the signals; ``driven`` has the entries of π, sup‖R_E x‖ and 1."""
    return np.array([0.0, after_test, estimation_error, *driven])
