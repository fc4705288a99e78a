"""The plant's inputs: which actuation each is of, how old it is, and when an update acts.

The limits of the times are those of the conditions under which a loop is certified.
"""

import math

import numpy as np
from numpy.typing import NDArray

from cosim.record.rows import Rows
from netem.core.clock import NS_PER_S
from noack.core.linear_systems import Vector
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    NO_SEQUENCE,
    PLANT_ACTUATION,
    PLANT_STEP,
)
from noack.theory.certificates.conditions import NetworkConditions
from tests.oracles.explained_run.findings import SCHEDULE, ExplainedLoop

Numbers = NDArray[np.int64]
INPUTS = "applied inputs"
_TOLERANCE_NS = 2


def check_applied(run: ExplainedLoop) -> None:
    """Check that each step applies the input of the newest actuation that is due, or the watchdog's."""
    steps, received = run.rows(PLANT_STEP), run.rows(PLANT_ACTUATION, time="now_ns")
    timing, m = run.scenario.timing, run.loop.m
    names = steps.dtype.names or ()
    at = np.searchsorted(received["input"], steps["input"])
    for row, place in zip(steps, at, strict=True):
        t_ns = int(row["t_ns"])
        newest = received[place - 1] if place else None
        number = NO_SEQUENCE if newest is None else int(newest["sequence"])
        if row["actuation"] != number:
            run.add(t_ns, INPUTS, f"actuation {row['actuation']} is applied, the newest received is {number}")
            continue
        inputs = np.zeros((1, m)) if newest is None else _inputs(newest, m)
        age_ns = t_ns - (0 if newest is None else int(newest["t_ns"]))
        if age_ns <= timing.actuation_timeout_ns:
            # Input k is due from ⌊k h⌋ ns on, h the period of the controller.
            due = math.ceil((max(age_ns, 0) + 1) / timing.controller_period.exact) - 1
            entry = min(due, len(inputs) - 1)
            expected = inputs[entry]
        else:
            entry, expected = -1, _watchdog_input(run, newest, inputs, t_ns)
        if "entry" in names and newest is not None and row["entry"] != entry:
            run.add(t_ns, INPUTS, f"input {row['entry']} of an actuation is applied, due is {entry}")
        if not run.is_near(row["u"], expected, *inputs):
            run.add(t_ns, INPUTS, f"u = {row['u']}, expected {expected}")


def _inputs(actuation: np.void, m: int) -> Vector:
    """Return the inputs of an actuation, (k, m)."""
    has_more = "predicted" in (actuation.dtype.names or ())
    more = actuation["predicted"].reshape(-1, m) if has_more else np.zeros((0, m))
    return np.vstack([actuation["u"].reshape(1, m), more])


def _watchdog_input(run: ExplainedLoop, newest: np.void | None, inputs: Vector, t_ns: int) -> Vector:
    policy = run.scenario.plant.watchdog.policy
    if policy == "zero":
        return np.zeros(inputs.shape[1])
    if policy == "hold" or newest is None:
        return np.asarray(inputs[-1 if policy == "hold" else 0])
    x_c = newest["x_c"]
    later = run.flow(x_c, int(newest["t_ns"]), t_ns)
    return np.asarray(inputs[0] + run.loop.K @ (later - x_c))


def check_schedule(run: ExplainedLoop, conditions: NetworkConditions) -> None:
    """Check when the first input and each update act, and how old inputs become."""
    steps = run.rows(PLANT_STEP)
    ticks, received = run.record[CONTROLLER_STEP], run.record[CONTROLLER_DELIVERY]
    first_tick = np.append(ticks["sequence"], np.iinfo(np.int64).max)[
        np.searchsorted(ticks["input"], received["input"])
    ]
    knows_start = run.scenario.network.initial_sync == "known_state"
    first = 0 if knows_start else first_tick[0] if len(first_tick) else np.iinfo(np.int64).max
    newest = np.maximum.accumulate(steps["actuation"]) if len(steps) else steps["actuation"]
    controlled = (newest >= first) & (newest != NO_SEQUENCE)
    start_ns = _first_time(steps, controlled)
    end_ns = int(steps["t_ns"][-1]) if len(steps) else 0
    _limit(run, 0, "the first input acts", min(start_ns, end_ns), conditions.start_s)
    _check_delays(run, conditions, steps, newest, first_tick, start_ns)
    _check_ages(run, conditions, steps[controlled])


def _first_time(steps: Rows, which: NDArray[np.bool_]) -> int:
    return int(steps["t_ns"][np.argmax(which)]) if which.any() else np.iinfo(np.int64).max


def _limit(run: ExplainedLoop, t_ns: int, what: str, value_ns: float, limit_s: float) -> None:
    if value_ns > limit_s * NS_PER_S + _TOLERANCE_NS:
        run.add(t_ns, SCHEDULE, f"{what} after {value_ns / NS_PER_S:.9f} s, at most {limit_s:.9f} s")


def _check_delays(
    run: ExplainedLoop,
    conditions: NetworkConditions,
    steps: Rows,
    newest: Numbers,
    first_tick: Numbers,
    start_ns: int,
) -> None:
    """Check the time from an event to the first step with an input computed from its update."""
    received, end_ns = run.record[CONTROLLER_DELIVERY], int(steps["t_ns"][-1]) if len(steps) else 0
    places = np.searchsorted(newest, first_tick)
    for row, place in zip(received, places, strict=True):
        event_ns = int(row["t_ns"])
        acts_ns = int(steps["t_ns"][place]) if place < len(steps) else end_ns
        if start_ns < acts_ns and event_ns < run.until_ns:
            what = f"update {row['sequence']} of the event at {event_ns / NS_PER_S:.6f} s acts"
            _limit(run, event_ns, what, acts_ns - event_ns, conditions.delay_s)


def _check_ages(run: ExplainedLoop, conditions: NetworkConditions, steps: Rows) -> None:
    """Check the age that each input reaches until the next step."""
    received, timing = run.record[PLANT_ACTUATION], run.scenario.timing
    sent_ns = dict(zip(received["sequence"].tolist(), received["t_ns"].tolist(), strict=True))
    for row in steps:
        has_entry = "entry" in (row.dtype.names or ())
        entry = int(row["entry"]) if has_entry else 0
        if entry < 0:  # the watchdog holds the last one
            entry = run.scenario.controller.predictions - 1
        ahead_ns = math.floor(entry * timing.controller_period.exact)
        input_ns = sent_ns.get(int(row["actuation"]), 0) + ahead_ns
        t_ns = int(row["t_ns"])
        age_ns = t_ns + timing.plant_period_ns - input_ns
        is_replaced = run.scenario.plant.watchdog.policy != "hold" and (
            t_ns - sent_ns.get(int(row["actuation"]), 0) > timing.actuation_timeout_ns
        )
        if is_replaced:
            run.add(t_ns, SCHEDULE, "the watchdog replaced the input")
        _limit(run, t_ns, "the applied input is replaced", age_ns, conditions.hold_s)
        if input_ns - t_ns > conditions.lead_s * NS_PER_S + _TOLERANCE_NS:
            run.add(t_ns, SCHEDULE, f"the applied input is for {(input_ns - t_ns) / NS_PER_S:.9f} s later")
