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
    PLANT_ACTUATION,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
    effective,
)
from noack.theory.certificate import Conditions

_TOLERANCE_S = 1e-9

Times = NDArray[np.int64]
Reals = NDArray[np.float64]


Left = tuple[float, str] | None
"""When a run left the conditions of a claim, and how; None if it never did."""


class Series(NamedTuple):
    """A condition's value over time: k values, each known from its time on."""

    t_s: Reals
    value: Reals

    def largest(self) -> float | None:
        """The largest value; None if there is none."""
        return float(self.value.max()) if len(self.value) else None


class Losses(NamedTuple):
    """The events, and which of their updates never came."""

    t_s: Reals
    """(k,)"""
    made_up_s: Reals
    """(k,) After which time the plant felt a newer update instead: infinite if the update was
    dropped, 0 if it came or was still to come; in between if it was overtaken."""

    def runs(self, delay_s: float) -> Series:
        """Successive losses at every event; what was overtaken within ``delay_s`` is not lost."""
        runs, run = [], 0
        for made_up_s in self.made_up_s.tolist():
            lost = made_up_s == np.inf or made_up_s > delay_s + _TOLERANCE_S
            run = run + 1 if lost else 0
            runs.append(run)
        return Series(self.t_s, np.array(runs, dtype=np.float64))


class Observed(NamedTuple):
    """What :class:`noack.theory.certificate.Conditions` presupposes, as it was."""

    losses: Losses
    """Updates that the controller never took."""
    sampling: Series
    """Time since the measurement before, in seconds, at every measurement."""
    delay: Series
    """From an event until the controller had its update and the plant felt it, at the event."""
    hold: Series
    """How far the model's time behind the input was from now at most, at every step."""
    start_s: float
    """When the plant began to feel the controller; infinite if never."""

    def left(self, conditions: Conditions) -> Left:
        """When and how the run first left the conditions; None if it never did."""
        limits = (
            (self.losses.runs(conditions.delay_s), conditions.dropouts,
             "{:.0f} updates lost in a row, {:.0f} allowed"),
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
            "dropouts": self.losses.runs(0.0).largest(),
            "sampling_s": self.sampling.largest(),
            "delay_s": self.delay.largest(),
            "hold_s": self.hold.largest(),
            "start_s": self.start_s if np.isfinite(self.start_s) else None,
        }


def observe(record: RunRecord) -> Observed:
    """Read the conditions off the record of a run, complete or not: what is not known is late."""
    steps, sensor = record[PLANT_STEP], record[SENSOR_MEASUREMENT]
    events = sensor[sensor["event"] != NO_SEQUENCE]
    model_ns, felt = _latched(record)
    known = record.scenario.network.initial_sync == "known_state"
    feels = (steps["actuation"] != NO_SEQUENCE) & (known | (felt != NO_SEQUENCE))
    step_s = steps["t_ns"] * 1e-9
    start_s = float(step_s[np.flatnonzero(feels)[0]]) if feels.any() else np.inf
    until_ns = steps["t_ns"] + record.scenario.plant_period_ns
    # A plant that is late latches what is of its future.
    age_ns = np.maximum(until_ns - model_ns, model_ns - steps["t_ns"])
    end_ns = max(int(rows["t_ns"][-1]) if len(rows) else 0 for rows in (steps, sensor))
    return Observed(
        losses=_losses(record, events, felt, end_ns),
        sampling=_sampling(sensor["t_ns"], end_ns),
        delay=_delays(record, events, felt, end_ns, start_s),
        hold=Series(step_s[feels], age_ns[feels] * 1e-9),
        start_s=start_s,
    )


def _latched(record: RunRecord) -> tuple[Times, Times]:
    """Of each step's input: the model's time behind it, and the newest update in it."""
    steps, ticks = record[PLANT_STEP], record[CONTROLLER_STEP]
    inputs, deliveries = record[PLANT_ACTUATION], record[CONTROLLER_DELIVERY]
    newest = np.append(NO_SEQUENCE, deliveries["sequence"])[
        np.searchsorted(deliveries["input"], ticks["input"])
    ]
    tick = _index(ticks["sequence"], steps["actuation"])
    # The plant knows a tick's time even if the controller did not live to tell the rest.
    taken = _index(inputs["sequence"], steps["actuation"])
    tick_ns = np.append(inputs["t_ns"], 0)[taken]
    model_ns = np.where(tick >= 0, np.append(ticks["model_t_ns"], 0)[tick], tick_ns)
    felt = np.append(newest, NO_SEQUENCE)[tick]
    return model_ns, np.maximum.accumulate(felt) if len(felt) else felt


def _index(ascending: Times, wanted: Times) -> NDArray[np.intp]:
    """Where the wanted numbers are; −1 where they are not."""
    found = np.searchsorted(ascending, wanted)
    there = np.append(ascending, NO_SEQUENCE)[found] == wanted
    return np.where(there & (wanted != NO_SEQUENCE), found, -1)


def _sampling(measured_ns: Times, end_ns: int) -> Series:
    """From the start and to the end, too."""
    times_ns = np.concatenate([[0], measured_ns, [end_ns]])
    gaps_ns = np.diff(times_ns)
    kept = gaps_ns > 0
    return Series(times_ns[:-1][kept] * 1e-9, gaps_ns[kept] * 1e-9)


def _delays(
    record: RunRecord, events: NDArray[np.void], felt: Times, end_ns: int, start_s: float
) -> Series:
    """Of every update that was not lost: until the model had it and the plant felt it.

    Of one that was not heard of until the end, as long as it could have been.
    """
    step_ns, deliveries = record[PLANT_STEP]["t_ns"], record[CONTROLLER_DELIVERY]
    sequences = events["event"]
    taken = _index(deliveries["sequence"], sequences)
    newest = int(deliveries["sequence"].max(initial=NO_SEQUENCE))
    pending = (sequences > newest) & ~np.isin(sequences, list(_fates(record)[0]))
    felt_ns = np.append(step_ns, end_ns)[np.searchsorted(felt, sequences)]
    model_ns = np.append(deliveries["model_t_ns"], 0)[taken]
    acts_ns = np.where(pending, end_ns, np.maximum(felt_ns, model_ns))
    # What the start brings with it is the start's.
    counts = (pending | (taken >= 0)) & (acts_ns * 1e-9 > start_s)
    delay_ns = (acts_ns - events["t_ns"]).clip(min=0)
    return Series(events["t_ns"][counts] * 1e-9, delay_ns[counts] * 1e-9)


def _fates(record: RunRecord) -> tuple[set[int], set[int]]:
    """The updates that the network dropped, and those that it let pass."""
    packets, sequences, _ = updates_in(record[NETEM_PACKET])
    dropped = ~effective(packets["fate"])
    return set(sequences[dropped].tolist()), set(sequences[~dropped].tolist())


def _losses(record: RunRecord, events: NDArray[np.void], felt: Times, end_ns: int) -> Losses:
    """What never came; an update that is under way at the end is not lost."""
    taken, sequences = record[CONTROLLER_DELIVERY]["sequence"], events["event"]
    dropped, passed = (np.isin(sequences, list(fates)) for fates in _fates(record))
    superseded = sequences < taken.max(initial=NO_SEQUENCE)
    lost = ~np.isin(sequences, taken) & (superseded | dropped)
    # Had it only been overtaken, a newer one made up for it, or has until the run's end not yet.
    step_s = np.append(record[PLANT_STEP]["t_ns"], end_ns) * 1e-9
    felt_s = step_s[np.searchsorted(felt, sequences)] - events["t_ns"] * 1e-9
    made_up_s = np.where(lost, np.where(passed & superseded, felt_s, np.inf), 0.0)
    return Losses(events["t_ns"] * 1e-9, made_up_s)
