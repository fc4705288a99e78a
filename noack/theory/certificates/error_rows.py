"""How the errors of a loop depend on the signals v of its inequalities: as rows of v.

(I1) bounds ‖C e_s‖ and ‖C e_c‖ by numbers that are not negative, times the signals (see
:mod:`noack.theory.certificates.inequalities`). :class:`ErrorRows` returns these numbers, for assumed
inter-event times and missing events.
"""

import math
from collections.abc import Mapping, Sequence
from enum import Enum, IntEnum
from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix, Vector
from noack.theory.bounds.certificate_terms import CertificatePart, NetworkConditions
from noack.theory.bounds.error_growth import COARSE_CELLS, ErrorGrowth
from noack.theory.bounds.gains import Counts, Output, sum_of_sups


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


class BoundMethod(Enum):
    """The ways to bound e_c. Bounds of parts may be added only if they use the same method."""

    MISSING = "by e_s and by the errors of all missing events"
    DRIFTING = "by its value d ago, and by what has driven it since"


class ErrorRows:
    """The rows of one part's errors.

    Args:
        part: that of one loop, or of several, as in the inequalities.
        conditions: those of the network.
        first_input_error: bound of ‖p‖ before the first input.
        begin_s: time of the first input; infinite if the first inputs at a set-point are applied before.
    """

    def __init__(
        self, part: CertificatePart, conditions: NetworkConditions, first_input_error: Vector, begin_s: float
    ) -> None:
        self._error, self._plant, bound, _ = part
        self._longest_s = bound.times.longest_s
        self._conditions = conditions
        self._first_input_error, self._begin_s = first_input_error, begin_s

    def signals(
        self, method: BoundMethod, events: Counts, inter_event_s: Vector, own_growth: ErrorGrowth | None
    ) -> "SignalRows":
        """Return how all outputs depend on v.

        Every ‖e_s‖_W has grown by ``own_growth`` from at most b at the last test; without it b is β̃. An
        event's x_s − x̂ is at most this plus η, the present x_s − x is at most this.
        """
        sensor = UNIT_ROWS[Signal.AFTER_TEST]
        if own_growth is not None:
            sensor = self.with_start(
                signal_row(own_growth.stretch, 0.0, own_growth.driven), own_growth.highest
            )
        counted = events
        at_present = present = {output: self._present(output, own_growth) for output in self._error.outputs}
        if drifts := method is BoundMethod.DRIFTING:
            # d ago, e_c consisted of e_s and of the errors of events that are lost.
            counted = np.full_like(events, self._conditions.dropouts)
            present = {
                output: self._present(output, own_growth, self._conditions.delay_s) for output in at_present
            }

        def with_missing(
            output: Output, present: Matrix, count: Counts, stages: _Stages | None = None
        ) -> Matrix:
            return self._with_missing(output, present, count, inter_event_s, own_growth, stages)

        stages = self._stages(present[Output.GAIN], counted, inter_event_s, own_growth)
        errors = {output: with_missing(output, row, counted, stages) for output, row in present.items()}
        input_error = errors[Output.GAIN]
        earlier = input_error if drifts else with_missing(Output.GAIN, np.zeros(len(Signal)), counted, stages)
        received = with_missing(Output.GAIN, at_present[Output.GAIN], 0 * events)
        return SignalRows(errors, sensor, received, earlier)

    def _present(self, output: Output, own_growth: ErrorGrowth | None, later_s: float = 0.0) -> Matrix:
        """Return the bound of sup‖C e_s‖ as a row of the signals.

        It is that of what e_s becomes, if nothing resets it, up to ``later_s`` after.
        """
        until_s, zero = later_s + (0.0 if own_growth is None else own_growth.longest_s), np.zeros(())
        driven: tuple[Vector, Vector, Vector] = (zero, zero, zero)
        if until_s > 0:
            growth = self._plant.growths(until_s, COARSE_CELLS)[output]
            driven = growth.totals if own_growth is None else growth.means(own_growth.ages_s + later_s)
        return signal_row(self._error.now_until(until_s)[output], 0.0, driven)

    def _with_missing(
        self,
        output: Output,
        present: Matrix,
        events: Counts,
        inter_event_s: Vector,
        own_growth: ErrorGrowth | None,
        stages: "_Stages | None" = None,
    ) -> Matrix:
        """Return the bound of sup‖C e_c‖ as a row of the signals, given that of e_s, ``present``.

        The part of e_s that has grown since the last test is followed from where it entered.
        """
        gain = self._missing_gain(output, events, inter_event_s)
        driven: list[Vector | float] = (
            [0.0] * 3 if own_growth is None else [gain * size for size in own_growth.driven]
        )
        if own_growth is not None and own_growth.longest_s > 0:
            for index, kernel in enumerate(self._plant.driven[output]):
                followed = own_growth.mean_s * sum_of_sups(kernel, events, inter_event_s)
                driven[index] = np.minimum(driven[index], followed)
        highest = self._plant.driven[output][0].sup() if self._error.decays else 0.0
        row = self.with_start(present + signal_row(gain, gain, driven), highest)
        if stages is not None and own_growth is not None:
            row[..., Signal.INPUT_ERROR] = present[..., Signal.INPUT_ERROR]
            row += stages.entered(
                *self._input_effects(output, len(stages.inputs), inter_event_s, own_growth), events
            )
        return row

    def with_start(self, row: Matrix, highest: Vector | float) -> Matrix:
        """Add what enters before the first input, where ‖p‖ is not bounded by π.

        ``highest`` bounds what a p of 1 adds in a unit of time.
        """
        by_first_input = np.fmin(row[..., Signal.INPUT_ERROR], self._begin_s * highest)
        return np.asarray(row + (self._first_input_error * by_first_input)[..., None] * UNIT_ROWS[Signal.ONE])

    def _input_effects(
        self, output: Output, count: int, inter_event_s: Vector, own_growth: ErrorGrowth
    ) -> tuple[Matrix, Matrix]:
        """Bound how inputs before missing events move C e_c, from the newest event on.

        Returns:
            Of the inputs since the test before the event, for ‖p‖ ≤ 1, and of those of one second,
            (count, loops) each.
        """
        ages_s = inter_event_s[:, None] * np.arange(count)
        sups = np.broadcast_to(self._plant.driven[output][0].sups(ages_s), ages_s.shape).T
        gains = self._error.kernels[output].sups(ages_s).T
        return np.minimum(gains * own_growth.driven[0], own_growth.mean_s * sups), sups

    def _stages(
        self, present: Matrix, events: Counts, inter_event_s: Vector, own_growth: ErrorGrowth | None
    ) -> "_Stages | None":
        """Bound ‖p‖ while at most 0, 1, … events are missing; None where π is used instead.

        p since the test before a missing event was caused by fewer missing events, except before an
        update that was received has taken effect. ``present`` is the part of sup‖K e_c‖ that is not
        from missing events.
        """
        count, delay_s = int(events.max(initial=0)), self._conditions.delay_s
        if (
            own_growth is None
            or own_growth.longest_s == 0
            or not 0 < count <= MOST_STAGES
            or not inter_event_s.all()
        ):
            return None
        # p of each stage: a row of the signals.
        sizes, sups = self._input_effects(Output.GAIN, count, inter_event_s, own_growth)
        shape = len(inter_event_s), len(Signal)
        late_s = (delay_s - np.arange(count)[:, None] * inter_event_s).clip(0.0, own_growth.longest_s)
        counts = np.arange(count)[:, None] + np.zeros_like(events)
        rows = self._with_missing(Output.GAIN, present, counts, inter_event_s, own_growth)
        rows += UNIT_ROWS[Signal.AGE_INPUT]
        # The share of π from updates that act late.
        highest = float(np.max(self._plant.driven[Output.GAIN][0].sup()))
        by_input = present[..., Signal.INPUT_ERROR]
        input_before_update = np.minimum(by_input, highest * (delay_s - counts * inter_event_s).clip(min=0.0))
        rows[..., Signal.INPUT_ERROR] = input_before_update
        shares_left = 1 - (by_input - input_before_update)[..., None]
        # Stage by stage; π where its own share is 1 or more.
        stages = _Stages(np.zeros((0, *shape)), late_s)
        for row, share_left, number in zip(rows, shares_left, counts, strict=True):
            row = row + stages.entered(sizes, sups, number)
            solved = row / np.where(share_left > 0, share_left, 1.0)
            row = np.where(share_left > 0, solved, UNIT_ROWS[Signal.INPUT_ERROR])
            stages = stages._replace(inputs=np.concatenate([stages.inputs, row[None]]))
        return stages

    def _missing_gain(self, output: Output, events: Counts, inter_event_s: Vector) -> Vector:
        if self._error.decays or math.isinf(self._longest_s):
            return self._error.missing(output, events, inter_event_s)
        return self._error.missing_until(output, events, self._longest_s)


class _Stages(NamedTuple):
    """Bounds of ‖p‖ while few events are missing."""

    inputs: Matrix
    """Rows of the signals, while 0, 1, … events are missing, (count, loops, 6)."""
    late_s: Matrix
    """For how long after the test before the first, second, … missing event an earlier update may
    not have taken effect yet, (count, loops)."""

    def entered(self, sizes: Matrix, sups: Matrix, events: Counts) -> Matrix:
        """Bound what has entered e_c before up to ``events`` missing events, (loops, 6).

        ``sizes`` and ``sups`` are those of :meth:`ErrorRows._input_effects`.
        """
        largest = np.zeros(self.inputs.shape[1:])
        for count in range(1, len(self.inputs) + 1):
            late = np.minimum(sizes[:count], self.late_s[count - 1 :: -1] * sups[:count])
            row = np.einsum("kl,klj->lj", sizes[:count] - late, self.inputs[count - 1 :: -1])
            row[:, Signal.INPUT_ERROR] += late.sum(axis=0)
            largest = np.where((count <= events)[:, None], np.maximum(largest, row), largest)
        return largest


class SignalRows(NamedTuple):
    """The errors as linear functions of the signals: rows, (…, 6)."""

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


def signal_row(
    after_test: Vector | float, estimation_error: Vector | float, driven: Sequence[Vector | float]
) -> Matrix:
    """Return a row of the signals; ``driven`` has the entries of π, sup‖R_E x‖ and 1."""
    return columns(0.0, after_test, estimation_error, *driven)


def columns(*values: Vector | float) -> Matrix:
    """Return values of loops, (…), side by side, (…, k)."""
    columns = np.empty((*np.broadcast(*values).shape, len(values)))
    for index, value in enumerate(values):
        columns[..., index] = value
    return columns
