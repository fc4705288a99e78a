"""Which update the controller computed each of the plant's inputs with, and how old the inputs were."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.record.run_events import ActuationTimes
from cosim.record.run_record import RunRecord
from netem.core.row_operations import largest_sizes
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    NO_SEQUENCE,
    PLANT_ACTUATION,
    PLANT_STEP,
)
from plant_server.plant import too_old

Times = NDArray[np.int64]
Reals = NDArray[np.float64]
_TOLERANCE_S = 1e-9
"""Times in seconds have rounding errors below this."""
_NO_TICK = 2**63 - 1
"""Stands for the number of a tick that does not exist; all others are smaller."""


class Excess(NamedTuple):
    """How far a series exceeded a limit."""

    first_s: float
    """The first time above it."""
    worst: float
    """The largest value."""
    worst_at_s: float
    """The time of the largest value."""


class SampledSeries(NamedTuple):
    """A condition's value over time: k values, each determined at its time."""

    t_s: Reals
    value: Reals

    def largest(self) -> float | None:
        """The largest value; None if there is none."""
        return float(self.value.max()) if len(self.value) else None

    def excess(self, limit: float) -> Excess | None:
        """Return how far the values exceed a limit; None if they keep it."""
        beyond = np.flatnonzero(self.value > limit + _TOLERANCE_S)
        if not len(beyond):
            return None
        largest = int(beyond[self.value[beyond].argmax()])
        return Excess(float(self.t_s[beyond[0]]), float(self.value[largest]), float(self.t_s[largest]))

    def before(self, t_s: float) -> "SampledSeries":
        """Return the values before a time."""
        early = self.t_s < t_s
        return SampledSeries(self.t_s[early], self.value[early])


class AppliedUpdate(NamedTuple):
    """An update that the controller received."""

    sequence: int
    model_ns: int
    """Model time of the reset."""
    applied_ns: int | None
    """Time of the plant's first step with an input computed with it; None: there was none."""


class PlantInputs(NamedTuple):
    """The inputs of a run's plant."""

    hold: SampledSeries
    """Largest age of the input, until the next step, at each step."""
    lead: SampledSeries
    """By how much the input was computed for a later time, at the steps at which it was."""
    watchdog: SampledSeries
    """Ages of actuations that the watchdog replaced."""
    safe_input: SampledSeries
    """Sizes of inputs of a controller without a state."""
    start_s: float
    """Time of the first input of a controller with a state; infinite if there was none."""
    updates: list[AppliedUpdate]
    """In the order in which they were received."""
    t_ns: Times
    """Time of each step of the plant, (k,)."""
    actuation: Times
    """Newest actuation of each step, (k,); ``NO_SEQUENCE`` before the first one."""
    input_ns: Times
    """Time for which the controller computed the input of each step, (k,)."""
    is_controlled: NDArray[np.bool_]
    """Whether the input of each step comes from a controller with a state, (k,)."""


def plant_inputs(record: RunRecord) -> PlantInputs:
    """Read the inputs of a run's plant."""
    timing = record.scenario.timing
    sequence, model_ns, ticks = _received(record)
    # The first tick with a state.
    first_state = int(ticks[0]) if len(ticks) else _NO_TICK
    if record.scenario.network.initial_sync == "known_state":
        first_state = 0
    t_ns, newest, sizes, ahead_ns = _steps(record)
    actuations = ActuationTimes()
    actuations.add(record.columns(PLANT_ACTUATION, "sequence", "t_ns"))
    sent_ns, _ = actuations.of_newest(newest)
    highest = np.maximum.accumulate(np.append(NO_SEQUENCE, newest))
    is_input = newest != NO_SEQUENCE
    controlled = is_input & (highest[1:] >= first_state)
    input_ns = sent_ns + ahead_ns
    age_ns = np.maximum(t_ns + timing.plant_period_ns - input_ns, 0)
    # A late step of the plant may apply an input with a model time after the step's nominal time.
    lead_ns = np.maximum(input_ns - t_ns, 0)
    replaces = record.scenario.plant.watchdog.policy != "hold"
    replaced = controlled & replaces & too_old(t_ns, sent_ns, timing.actuation_timeout_ns)
    # Until the first input with a state, the certificates assume that the input is 0.
    safe = is_input & ~controlled & ~(sizes == 0)
    step_s, is_held = t_ns * 1e-9, controlled & ~replaced
    leads = is_held & (lead_ns > 0)
    # Each actuation is first applied at the step at which it is the newest one.
    rises = np.diff(highest) > 0
    latched, latched_ns = highest[1:][rises], t_ns[rises]
    first = np.searchsorted(latched, ticks).tolist()
    applied_ns = [int(latched_ns[i]) if i < len(latched) else None for i in first]
    return PlantInputs(
        hold=SampledSeries(step_s[is_held], age_ns[is_held] * 1e-9),
        lead=SampledSeries(step_s[leads], lead_ns[leads] * 1e-9),
        watchdog=SampledSeries(step_s[replaced], (t_ns - sent_ns)[replaced] * 1e-9),
        safe_input=SampledSeries(step_s[safe], sizes[safe]),
        start_s=float(step_s[np.argmax(controlled)]) if controlled.any() else np.inf,
        updates=[*map(AppliedUpdate, sequence.tolist(), model_ns.tolist(), applied_ns)],
        t_ns=t_ns,
        actuation=newest,
        input_ns=input_ns,
        is_controlled=is_held,
    )


def _received(record: RunRecord) -> tuple[Times, Times, Times]:
    """Return the updates that the controller received: number, model time, first tick with each."""
    ticks = record.columns(CONTROLLER_STEP, "input", "sequence")
    received = record.columns(CONTROLLER_DELIVERY, "input", "sequence", "model_t_ns")
    following = np.searchsorted(ticks["input"], received["input"], "right")
    return received["sequence"], received["model_t_ns"], np.append(ticks["sequence"], _NO_TICK)[following]


def _steps(record: RunRecord) -> tuple[Times, Times, NDArray[np.float64], Times]:
    """Return of each step its time, newest actuation, size of the input, and how far it was predicted."""
    names = record.tables[PLANT_STEP].names or ()
    columns = ("t_ns", "actuation", "u", *(["entry"] if "entry" in names else []))
    times, newest, sizes, ahead = [], [], [], []
    whole_ns, part, parts = record.scenario.timing.controller_period.core
    for rows in record.batches(PLANT_STEP, columns):
        times.append(rows["t_ns"])
        newest.append(rows["actuation"])
        with np.errstate(invalid="ignore"):
            sizes.append(largest_sizes(rows["u"]))
        # The age of an input that was predicted counts from the time that it is for.
        predicted = np.maximum(rows["entry"], 0) if "entry" in names else np.zeros(len(rows), np.int64)
        ahead.append(predicted * whole_ns + predicted * part // parts)
    no_times, no_sizes = np.zeros(0, np.int64), np.zeros(0)
    integers = (np.concatenate([no_times, *part]) for part in (times, newest, ahead))
    t_ns, numbers, ahead_ns = integers
    return t_ns, numbers, np.concatenate([no_sizes, *sizes]), ahead_ns
