"""Reads from a live run's record, in steps of the plant, when updates and inputs took effect."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.claims.condition_reader import read_conditions
from cosim.record.recorded_changes import changes_of
from cosim.record.run_record import Rows, RunRecord
from cosim.simulation.continuous import network_fates
from cosim.simulation.plant_grid_loop import NO_ACTUATION, StepSchedule
from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix, Vector
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    NO_SEQUENCE,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
)

_LEAST_MEASUREMENTS = 10
_NEVER_NS = 2**62
_LARGEST = 1e100


class IncomparableError(CallerError):
    """The run's record does not allow the comparison; the message has the reason."""


class LiveRun(NamedTuple):
    """A live run on the plant's grid, up to its last measurement."""

    schedule: StepSchedule
    x: Matrix
    """The plant's state at the measurements, (k, n)."""
    event_s: Vector
    """Times of the events."""


def live_run(record: RunRecord) -> LiveRun:
    """Read the schedule of a run.

    Raises:
        IncomparableError: the run diverged, a process was restarted, settings were changed, the
            record is too short or has gaps, or some inputs were not those of the controller's
            model.
        CallerError: exact simulation does not support the scenario.
    """
    _require_ideal(record)
    steps = record.columns(PLANT_STEP, "sequence", "actuation", "x")
    sensor = record.columns(SENSOR_MEASUREMENT, "input", "t_ns", "event")
    ticks, deliveries = (
        record.columns(table, "input", "sequence", "model_t_ns")
        for table in (CONTROLLER_STEP, CONTROLLER_DELIVERY)
    )
    count = len(sensor)
    _require(
        count >= _LEAST_MEASUREMENTS,
        f"the record holds {count} measurements; {_LEAST_MEASUREMENTS} are needed",
    )
    period_ns = record.scenario.timing.plant_period_ns
    last = int(sensor["t_ns"][-1]) // period_ns
    steps = steps[: last + 1]
    whole = len(steps) > last and np.array_equal(steps["sequence"], np.arange(last + 1))
    _require(whole, "steps of the plant are missing from the record")
    whole = np.array_equal(sensor["input"], np.arange(count))
    _require(whole, "measurements are missing from the sensor's record")
    horizon_ns = record.scenario.timing.horizon_ns
    _require_times(SENSOR_MEASUREMENT, sensor["t_ns"], horizon_ns)
    _require_times(CONTROLLER_STEP, ticks["model_t_ns"], horizon_ns)
    _require_times(CONTROLLER_DELIVERY, deliveries["model_t_ns"], horizon_ns)
    _require(bool(np.abs(steps["x"]).max() < _LARGEST), "the run diverged")  # also for NaN
    measured = np.zeros(last + 1, dtype=np.bool_)
    measured[sensor["t_ns"] // period_ns] = True
    origins, accepted = _ticks(ticks, deliveries)
    latched = _latched(steps["actuation"], origins)
    seen = read_conditions(record)
    _require(
        not (len(seen.watchdog.t_s) or len(seen.safe_input.t_s)),
        "the ideal loop has no watchdog and no safe input, which this run applied for a time",
    )
    events = sensor[sensor["event"] != NO_SEQUENCE]
    numbers, event_ns = np.arange(len(events)), events["t_ns"]
    acts_at_tick = np.searchsorted(origins.newest, numbers)
    acts_at_step = np.searchsorted(latched.newest, numbers)
    act_ns = np.append(origins.model_ns, _NEVER_NS)[acts_at_tick]
    network = network_fates(record.scenario)
    schedule = StepSchedule(
        period_ns=period_ns,
        measured=measured,
        delivered=lambda event: event in accepted if event < len(events) else network(event),
        delay_ns=_delays(accepted, act_ns - event_ns, act_ns < _NEVER_NS),
        delay_steps=_delays(accepted, acts_at_step - event_ns // period_ns, acts_at_step <= last),
        model_ns=latched.model_ns,
    )
    return LiveRun(schedule, steps["x"][measured], event_ns * 1e-9)


def _require_ideal(record: RunRecord) -> None:
    """Require settings and processes that stayed the same, and a loop with an exact simulation."""
    changed, restarted = bool(changes_of(record)), record.restarted()
    _require(not changed, "the ideal loop has no changes of settings, as this run has")
    record.scenario.coverage.require_unchanging()
    record.scenario.coverage.require_exact()
    why = f"the ideal loop has no restarts: {restarted} was restarted during the run"
    _require(restarted is None, why)


def _require(met: bool, why: str) -> None:
    if not met:
        raise IncomparableError(why)


def _require_times(table: str, times_ns: NDArray[np.int64], horizon_ns: int) -> None:
    """Require possible times: with others, as in a damaged record, a simulation would not end."""
    possible = (times_ns >= 0).all() and (times_ns <= horizon_ns).all()
    possible = possible and (np.diff(times_ns) >= 0).all()
    _require(bool(possible), f"the record's {table} has times that no run has")


class _Ticks(NamedTuple):
    """The origin of the controller's actuations (by sequence number) or of the plant's steps."""

    model_ns: NDArray[np.int64]
    newest: NDArray[np.int64]
    """Sequence number of the newest update that they use, −1 for none."""


def _ticks(ticks: Rows, deliveries: Rows) -> tuple[_Ticks, set[int]]:
    """Return the origin of each actuation, and the updates that the controller accepted."""
    inputs = np.sort(np.concatenate([ticks["input"], deliveries["input"]]))
    whole = np.array_equal(inputs, np.arange(len(inputs)))
    whole = whole and np.array_equal(ticks["sequence"], np.arange(len(ticks)))
    _require(whole, "ticks or deliveries are missing from the controller's record")
    sequences = np.concatenate([[NO_SEQUENCE], deliveries["sequence"]])
    newest = sequences[np.searchsorted(deliveries["input"], ticks["input"])]
    return _Ticks(ticks["model_t_ns"], newest), set(deliveries["sequence"].tolist())


def _latched(actuations: NDArray[np.int64], ticks: _Ticks) -> _Ticks:
    """Return the origin of the input held from each step on; −1 before the first."""
    known = bool(actuations.max(initial=NO_SEQUENCE) < len(ticks.newest))
    _require(known, "the controller's record ends before the plant's")
    by_sequence = _Ticks(
        np.append(ticks.model_ns, NO_ACTUATION), np.append(ticks.newest, NO_SEQUENCE)
    )
    return _Ticks(by_sequence.model_ns[actuations], by_sequence.newest[actuations])


def _delays(
    accepted: set[int], delays: NDArray[np.int64], acted: NDArray[np.bool_]
) -> Callable[[int], int]:
    """Return the recorded delays; for events that the run did not have, their median."""
    usable = [int(delays[event]) for event in accepted if event < len(delays) and acted[event]]
    usual = int(np.median(usable)) if usable else 0
    return lambda event: int(delays[event]) if event < len(delays) else usual
