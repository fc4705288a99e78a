"""Under which conditions a run really took place, in the plant's time: from its record."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.record import RunRecord, updates_in
from noack.records import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    NETEM_PACKET,
    NO_SEQUENCE,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
    Fate,
)
from noack.theory.certificate import Conditions

_TOLERANCE_S = 1e-9

Times = NDArray[np.int64]
Reals = NDArray[np.float64]


class Series(NamedTuple):
    """A condition's value over time: k values, each known from its time on."""

    t_s: Reals
    value: Reals

    def largest(self) -> float | None:
        """The largest value; None if there is none."""
        return float(self.value.max()) if len(self.value) else None


class Observed(NamedTuple):
    """What :class:`noack.theory.certificate.Conditions` presupposes, as it was."""

    dropouts: Series
    """Successive updates that the controller never took, at every event."""
    sampling: Series
    """Time since the measurement before, in seconds, at every measurement."""
    delay: Series
    """From an event until the plant felt its update, at the event."""
    hold: Series
    """Greatest age of the model state behind the input in force, at every step."""
    start_s: float
    """When the plant began to feel the controller; infinite if never."""

    def left(self, conditions: Conditions) -> tuple[float, str] | None:
        """When and how the run first left the conditions; None if it never did."""
        limits = (
            (self.dropouts, conditions.dropouts, "{:.0f} updates lost in a row, {:.0f} allowed"),
            (self.sampling, conditions.sampling_s,
             "no measurement for {:.4g} s, {:.4g} s allowed"),
            (self.delay, conditions.delay_s,
             "an update was felt after {:.4g} s, {:.4g} s allowed"),
            (self.hold, conditions.hold_s, "an input was {:.4g} s old, {:.4g} s allowed"),
        )  # fmt: skip
        found = []
        for series, limit, text in limits:
            beyond = np.flatnonzero(series.value > limit + _TOLERANCE_S)
            if len(beyond):
                first = int(beyond[0])
                worst = float(series.value.max())
                found.append((float(series.t_s[first]), text.format(worst, limit)))
        if self.start_s > conditions.start_s + _TOLERANCE_S:
            text = f"the plant felt no input until {self.start_s:.4g} s, "
            found.append((0.0, f"{text}{conditions.start_s:.4g} s allowed"))
        return min(found, default=None)

    def summary(self) -> dict[str, float | None]:
        """The largest value of each."""
        return {
            "dropouts": self.dropouts.largest(),
            "sampling_s": self.sampling.largest(),
            "delay_s": self.delay.largest(),
            "hold_s": self.hold.largest(),
            "start_s": self.start_s if np.isfinite(self.start_s) else None,
        }


def observe(record: RunRecord) -> Observed:
    """Read the conditions off the record of a run, complete or not."""
    steps, ticks = record[PLANT_STEP], record[CONTROLLER_STEP]
    deliveries, sensor = record[CONTROLLER_DELIVERY], record[SENSOR_MEASUREMENT]
    events = sensor[sensor["event"] != NO_SEQUENCE]
    known = record.scenario.network.initial_sync == "known_state"
    newest = np.append(NO_SEQUENCE, deliveries["sequence"])[
        np.searchsorted(deliveries["input"], ticks["input"])
    ]
    # Of each step: its actuation's tick, the model's time there, the newest update in it.
    tick = np.searchsorted(ticks["sequence"], steps["actuation"])
    tick = np.where(tick < len(ticks), tick, -1)
    has = (steps["actuation"] != NO_SEQUENCE) & (tick >= 0) & (len(ticks) > 0)
    felt = np.full(len(steps), NO_SEQUENCE, dtype=np.int64)
    model_ns = np.zeros(len(steps), dtype=np.int64)
    if has.any():
        felt[has], model_ns[has] = newest[tick[has]], ticks["model_t_ns"][tick[has]]
    felt = np.maximum.accumulate(felt) if len(felt) else felt
    feels = has & (known | (felt != NO_SEQUENCE))
    step_s = steps["t_ns"] * 1e-9
    start_s = float(step_s[np.flatnonzero(feels)[0]]) if feels.any() else np.inf
    until_ns = steps["t_ns"] + record.scenario.plant_period_ns
    return Observed(
        dropouts=_dropouts(record, events),
        sampling=_sampling(sensor["t_ns"], int(steps["t_ns"][-1]) if len(steps) else 0),
        delay=_delays(steps["t_ns"], felt, events, set(deliveries["sequence"].tolist()), start_s),
        hold=Series(step_s[feels], (until_ns - model_ns)[feels] * 1e-9),
        start_s=start_s,
    )


def _sampling(measured_ns: Times, end_ns: int) -> Series:
    times_ns = np.append(measured_ns, max(end_ns, int(measured_ns.max(initial=0))))
    gaps_ns = np.diff(times_ns)
    kept = gaps_ns > 0
    return Series(times_ns[:-1][kept] * 1e-9, gaps_ns[kept] * 1e-9)


def _delays(
    step_ns: Times, felt: Times, events: NDArray[np.void], taken: set[int], start_s: float
) -> Series:
    """Of every update that the controller took and the plant felt, or had not yet at the end."""
    events = events[[int(sequence) in taken for sequence in events["event"]]]
    if not len(events) or not len(step_ns):
        return Series(np.zeros(0), np.zeros(0))
    step = np.searchsorted(felt, events["event"])
    felt_ns = np.append(step_ns, step_ns[-1])[step]
    later = felt_ns * 1e-9 > start_s  # what the start brings with it is the start's
    return Series(
        events["t_ns"][later] * 1e-9, ((felt_ns - events["t_ns"])[later] * 1e-9).clip(min=0)
    )


def _dropouts(record: RunRecord, events: NDArray[np.void]) -> Series:
    """Runs of lost updates; one that is still under way at the end is not lost."""
    taken = record[CONTROLLER_DELIVERY]["sequence"]
    packets, sequences, _ = updates_in(record[NETEM_PACKET])
    dropped = set(sequences[packets["fate"] == Fate.DROPPED].tolist())
    newest, kept = int(taken.max(initial=NO_SEQUENCE)), set(taken.tolist())
    runs, run = [], 0
    for sequence in events["event"].tolist():
        lost = sequence not in kept and (sequence < newest or sequence in dropped)
        run = run + 1 if lost else 0
        runs.append(run)
    return Series(events["t_ns"] * 1e-9, np.array(runs, dtype=np.float64))
