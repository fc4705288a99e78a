"""Finds out which update the controller computed each of the plant's inputs with.

The rows of one process arrive in order; those of different processes may be far apart. So the rows
of ticks, deliveries and steps of the plant wait for one another, and only waiting rows are kept:

* :class:`TickMatcher` finds the first tick that was computed with each update;
* :class:`InputOrigins` finds the tick of each of the plant's inputs, with the input's age, and when
  each update took effect.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.claims.observed_conditions import SampledSeries
from cosim.record.run_events import ActuationTimes
from cosim.record.run_record import Rows
from noack.core.row_operations import largest_sizes
from noack.protocol.record_tables import NO_SEQUENCE
from noack.scenario.scenario import Scenario
from plant_server.plant import too_old

Times = NDArray[np.int64]
Batches = list[tuple[NDArray[Any], ...]]
"""Columns of the waiting rows, batch by batch."""
NO_INPUT = 2**63 - 1
"""Stands for the number of an input that does not exist; all others are smaller."""
NO_TIMES: Times = np.zeros(0, np.int64)
_KEPT_TICKS = 512
"""A process sends its tables one after the other, up to 256 rows of each."""


def columns(batches: Batches, count: int) -> tuple[NDArray[Any], ...]:
    """Concatenate batches of columns."""
    if not batches:
        return (NO_TIMES,) * count
    if len(batches) == 1:
        return batches[0]
    return tuple(np.concatenate(column) for column in zip(*batches, strict=True))


class Receipts(NamedTuple):
    """Updates that the controller received, with the first tick computed with each."""

    sequence: Times
    model_ns: Times
    """Model time of the reset."""
    tick: Times


class TickMatcher:
    """Finds the first tick computed with each update."""

    def __init__(self) -> None:
        self._ticks: Batches = []
        self._deliveries: Batches = []
        self.newest = NO_SEQUENCE

    def add_ticks(self, rows: Rows) -> None:
        """Add rows of the controller's ticks."""
        self._ticks.append((rows["input"], rows["sequence"]))
        self.newest = int(rows["sequence"][-1])

    def add_deliveries(self, rows: Rows) -> None:
        """Add rows of updates that the controller received."""
        self._deliveries.append((rows["input"], rows["sequence"], rows["model_t_ns"]))

    @property
    def waiting(self) -> int:
        """Number of rows that wait."""
        return sum(len(inputs) for inputs, *_ in self._deliveries)

    def take_receipts(self, *, ended: bool) -> Receipts:
        """Return the updates whose tick was determined; at the end, also those without a tick."""
        inputs, ticks = columns(self._ticks, 2)
        received, sequence, model_ns = columns(self._deliveries, 3)
        first = np.searchsorted(inputs, received, "right")
        known = len(received) if ended else int((first < len(inputs)).sum())
        self._deliveries = [(received[known:], sequence[known:], model_ns[known:])]
        self._ticks = [(inputs[-_KEPT_TICKS:], ticks[-_KEPT_TICKS:])]
        tick = np.append(ticks, NO_INPUT)[first[:known]]
        return Receipts(sequence[:known], model_ns[:known], tick)


class InputOrigins:
    """The origin of the plant's inputs, step by step."""

    def __init__(self, scenario: Scenario) -> None:
        self._period_ns = scenario.timing.plant_period_ns
        self._tick_ns = scenario.timing.controller_period_ns
        self._timeout_ns = scenario.timing.actuation_timeout_ns
        self._replaces = scenario.plant.watchdog.policy != "hold"
        known = scenario.network.initial_sync == "known_state"
        self._first_state = 0 if known else NO_INPUT
        """The controller's first tick with a state."""
        self._ticked = NO_SEQUENCE
        self._steps: Batches = []
        self._actuations = ActuationTimes()
        self._received = NO_SEQUENCE
        self._latched = NO_SEQUENCE
        self._latches: Batches = []
        self._receipts: Batches = []
        self.newest_ns = 0
        self.classified_ns = 0
        self.start_ns = 0
        self.started = False

    def add_steps(self, rows: Rows) -> None:
        """Add rows of the plant's steps."""
        with np.errstate(invalid="ignore"):
            sizes = largest_sizes(rows["u"])
        # The age of an input that was predicted counts from the time that it is for.
        ahead_ns = np.zeros(len(rows), np.int64)
        if "entry" in (rows.dtype.names or ()):
            ahead_ns = np.maximum(rows["entry"], 0) * self._tick_ns
        self._steps.append((rows["t_ns"], rows["actuation"], sizes, ahead_ns))
        self.newest_ns = int(rows["t_ns"][-1])

    def add_actuations(self, rows: Rows) -> None:
        """Add rows of actuations that the plant received."""
        self._actuations.add(rows)
        self._received = int(rows["sequence"][-1])

    @property
    def waiting(self) -> int:
        """Number of rows that wait."""
        stored = (self._steps, self._latches, self._receipts)
        return sum(len(batch[0]) for batches in stored for batch in batches)

    def add_receipts(self, receipts: Receipts, ticked: int) -> None:
        """Add updates that the controller received, and the number of its newest tick."""
        if len(receipts.tick):
            self._first_state = min(self._first_state, int(receipts.tick[0]))
        self._receipts.append(receipts)
        self._ticked = ticked

    def take_inputs(self, *, ended: bool) -> tuple[SampledSeries, SampledSeries, SampledSeries]:
        """Classify the steps with a known input.

        Returns:
            Ages of inputs; ages of actuations that the watchdog replaced; sizes of safe inputs.
        """
        t_ns, newest, sizes, ahead_ns = columns(self._steps, 4)
        ready = newest <= (NO_INPUT if ended else self._received)
        ready &= (newest <= self._ticked) | (self._first_state < NO_INPUT)
        count = int(np.minimum.accumulate(ready).sum())
        self._steps = [(t_ns[count:], newest[count:], sizes[count:], ahead_ns[count:])]
        t_ns, newest, sizes = t_ns[:count], newest[:count], sizes[:count]
        sent_ns, _ = self._actuations.of_newest(newest)
        model_ns = sent_ns + ahead_ns[:count]
        highest = np.maximum.accumulate(np.append(self._latched, newest))
        is_input = newest != NO_SEQUENCE
        controlled = is_input & (highest[1:] >= self._first_state)
        if count:
            self.classified_ns = int(t_ns[-1])
            rises = np.diff(highest) > 0
            self._latches.append((highest[1:][rises], t_ns[rises]))
            self._latched = int(highest[-1])
        if not self.started and controlled.any():
            self.started, self.start_ns = True, int(t_ns[np.argmax(controlled)])
        # A late plant step may apply an input with a model time after the step's nominal time.
        age_ns = np.maximum(t_ns + self._period_ns - model_ns, model_ns - t_ns)
        replaced = controlled & self._replaces & too_old(t_ns, sent_ns, self._timeout_ns)
        # Until the first input with a state, the certificates assume that the input is 0.
        safe = is_input & ~controlled & ~(sizes == 0)
        step_s, is_held = t_ns * 1e-9, controlled & ~replaced
        return (
            SampledSeries(step_s[is_held], age_ns[is_held] * 1e-9),
            SampledSeries(step_s[replaced], (t_ns - sent_ns)[replaced] * 1e-9),
            SampledSeries(step_s[safe], sizes[safe]),
        )

    def take_applied(self, *, ended: bool) -> list[tuple[int, int, int | None]]:
        """Return the updates that took effect on the plant since the last call, in order.

        Returns:
            Sequence number; model time of the reset, ns; time of the first step with an input
            computed with the update, ns, None if there was none.
        """
        sequence, model_ns, tick = columns(self._receipts, 3)
        latched, t_ns = columns(self._latches, 2)
        first = np.searchsorted(latched, tick)
        known = len(tick) if ended else int((first < len(latched)).sum())
        applied_ns = [int(t_ns[i]) if i < len(latched) else None for i in first[:known]]
        self._receipts = [(sequence[known:], model_ns[known:], tick[known:])]
        needed = latched > self._ticked  # steps with a later actuation than these ticks
        self._latches = [(latched[needed], t_ns[needed])]
        return [*zip(sequence[:known].tolist(), model_ns[:known].tolist(), applied_ns, strict=True)]
