"""Cuts the record of a run into parts that are checked as runs of their own.

* :func:`up_to_common_end`: a stopped run up to the last time that all of its processes reached.
* :func:`cut_part`: the part after a change of settings, in deviations from its set-point;
  :func:`start_error` is what its first inputs differ by.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from cosim.record.align import Reals
from cosim.record.run_record import Rows, RunRecord
from noack.core.clock import NS_PER_S
from noack.core.linear_systems import Vector
from noack.core.row_operations import row_norms
from noack.plants.plant_settings import SystemFailedError
from noack.plants.systems.jacobian_enclosure import NotEnclosedError
from noack.protocol.record_tables import (
    CLOCK_TABLES,
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    NETEM_PACKET,
    OWNER,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
    SETTINGS,
    STEP_TABLES,
)
from noack.protocol.roles import LOOP_ROLES
from noack.runtime.life_cycle import HORIZON
from noack.scenario.resolution import loop_of, policy_of, setpoint_of
from noack.scenario.scenario import Scenario
from noack.theory.bounds.disturbances import bound_forcing
from noack.theory.bounds.enclosure import factors
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import about_setpoint
from noack.theory.certificates.region import enclosed_motion


class RunPart(NamedTuple):
    """A part of a run that is checked as a run of its own; by default the whole run."""

    whole_record: RunRecord | None = None
    """The record of the run, if that of the part is another one."""
    from_s: float = 0.0
    """Start of the part, in the run's time."""
    until_s: float = math.inf
    """End of the claims, in the part's time; the record of the part continues."""
    start_error: float | None = None
    """‖u − Kx‖, scaled, until the plant applied the first input of this part; None if it applied
    no input before."""
    void: Mapping[str, str] = {}
    """By scope: why there is no certificate."""
    certificates: Sequence[ScenarioCertificate] | None = None
    """Those of the part's scenario, if they are known."""
    offset: float = 0.0
    """‖x_r‖ of the set-point: the part's x is x − x_r, and has the rounding errors of x."""


_TIMES = ("t_ns", "now_ns", "model_t_ns", "release_ns", "copy_ns")
_STATES = ("x", "x_s", "x_c", "x_c_before", "x_s_before")
_ROUNDED = 1e-9
"""Share of an input outside of the range of K that is rounding."""


def cut_part(record: RunRecord, scenario: Scenario, origin_ns: int, sequence: int | None) -> RunRecord:
    """Return the part of a run after the event ``sequence``, in the form of a separate record.

    The time of the event becomes time 0. Without an event it is the whole run.
    """
    setpoint = setpoint_of(scenario)
    loop = loop_of(scenario)
    x_r, u_r = (np.zeros(loop.n), np.zeros(loop.m)) if setpoint is None else setpoint

    def derive(table: str, part: Rows) -> Rows:
        if table in SETTINGS:
            part = part[:0]
        elif table in (SENSOR_MEASUREMENT, PLANT_STEP, CONTROLLER_STEP):
            part = part.compress(part["t_ns"] >= origin_ns)
        elif table == NETEM_PACKET or table in CLOCK_TABLES:
            part = part.compress(part["now_ns"] >= origin_ns)
        elif table == CONTROLLER_DELIVERY and sequence is not None:
            part = part[part["sequence"] >= sequence]
        rows = _shift(part, origin_ns, x_r, u_r)
        if sequence is not None:  # the state before the reset belongs to the last part
            _reset_first_row(table, rows, sequence)
        return rows

    x_0 = np.array(scenario.plant.initial_state) - x_r
    if sequence is not None:
        # The part begins with the plant's state at the event, which noise may hide from the sensor.
        table = SENSOR_MEASUREMENT if scenario.coverage.knows_state else PLANT_STEP
        derived = filter(len, (derive(table, rows) for rows in record.source.batches(table)))
        x_0 = next((rows["x"][0] for rows in derived), x_0)
    scenario = about_setpoint(scenario)
    update = {
        "plant": scenario.plant.model_copy(update={"initial_state": tuple(x_0.tolist())}),
        "horizon_s": max(scenario.horizon_s - origin_ns / NS_PER_S, 1e-9),
        "changes": (),
    }
    if sequence is not None:
        update["network"] = scenario.network.model_copy(update={"initial_sync": "first_packet"})
    update["trigger"] = scenario.trigger.at_origin(origin_ns / NS_PER_S)
    return record.derived(scenario.model_copy(update=update), derive)


def _reset_first_row(table: str, rows: Rows, sequence: int) -> None:
    """Change the row of the event at which a part of a run begins: it has no error before it."""
    if table == SENSOR_MEASUREMENT:
        first = np.flatnonzero(rows["t_ns"] == 0)[:1]
        rows["x_s"][first] = rows["x"][first]
        rows["e_s_norm"][first] = rows["compared"][first] = 0.0
    elif table == CONTROLLER_DELIVERY:
        rows["dropouts"][rows["sequence"] == sequence] = 0


def _shift(rows: Rows, origin_ns: int, x_r: Vector, u_r: Vector) -> Rows:
    """Return rows in the time of a part, as deviations from its set-point."""
    shifted = rows.copy()
    for name in rows.dtype.names or ():
        if name in _TIMES:
            shifted[name] -= origin_ns
        elif name in _STATES:
            shifted[name] -= x_r
        elif name == "u":
            shifted[name] -= u_r
    return shifted


def start_error(part_record: RunRecord, started_s: float) -> float:
    """sup‖u − Kx‖ e^{αt} over the steps until the plant applied the first input of the part.

    u is constant within a step. So ‖u − Kx‖ is at most the larger of its values at both ends, plus
    a term for the curvature of x: Δt²/8 sup‖K ẍ‖, of a linear plant with ẍ = A e^{As}(Ax + Bu + Dw),
    w constant.
    Infinite: u is not in the range of K, in which the bounds have it. It may be outside if K has
    fewer independent rows than there are inputs, and u was that of a set-point with another u_r; or
    u is not finite, or not recorded at each of these steps.
    """
    alpha = policy_of(part_record.scenario).fading_per_s
    period_ns = part_record.scenario.timing.plant_period_ns
    before_ns = -period_ns
    largest, last = 0.0, np.zeros(0, part_record.tables[PLANT_STEP])
    for batch in part_record.source.batches(PLANT_STEP):
        steps = np.concatenate([last, batch])
        ended = int(np.searchsorted(steps["t_ns"] * 1e-9, started_s)) + 1
        if (np.diff(steps["t_ns"][:ended], prepend=before_ns) > period_ns).any():
            return math.inf
        if len(steps[:ended]) > 1:
            largest = max(largest, _input_error(part_record, steps[:ended], alpha))
        if ended < len(steps):
            break
        last = steps[-1:]
        before_ns = int(last["t_ns"][0]) if len(last) else before_ns
    return max(largest, float(np.finfo(float).tiny))  # 0 would be that of a run from its start


def _input_error(part_record: RunRecord, steps: Rows, alpha_per_s: float) -> float:
    """Return the bound of ‖u − Kx‖ e^{αt} over at least two steps."""
    loop = part_record.loop
    x, u, dt_s = steps["x"], steps["u"][:-1], part_record.scenario.timing.plant_period_ns * 1e-9
    basis, _ = factors(loop.K)
    outside = row_norms(u - u @ basis @ basis.T)
    if (outside > _ROUNDED * (row_norms(u) + row_norms(x[:-1] @ loop.K.T))).any():
        return math.inf
    ends = np.maximum(row_norms(u - x[:-1] @ loop.K.T), row_norms(u - x[1:] @ loop.K.T))
    is_linear = part_record.scenario.coverage.linear_certificates_apply
    bend = (_bend if is_linear else _nonlinear_bend)(part_record, x[:-1], u, dt_s)
    largest = float(((ends + bend) * np.exp(alpha_per_s * steps["t_ns"][1:] * 1e-9)).max())
    return math.inf if math.isnan(largest) else largest


def _bend(part_record: RunRecord, x: Reals, u: Reals, dt_s: float) -> Reals:
    """Return Δt²/8 sup‖KAẋ‖ within each step of a linear plant."""
    loop = part_record.loop
    speed = x @ loop.A.T + u @ loop.B.T
    # ‖KA e^{As} ẋ‖ is at most ‖KA ẋ‖ + ‖KA‖ ‖e^{As} − I‖ ‖ẋ‖.
    gain = loop.K @ loop.A
    turned = float(np.linalg.norm(gain, 2)) * math.expm1(min(float(np.linalg.norm(loop.A, 2)) * dt_s, 700.0))
    forced, forcing = 0.0, bound_forcing(part_record.scenario, loop.B)
    if forcing is not None:
        sizes = np.linalg.norm(gain @ forcing.limited, axis=0)
        forced = float((sizes + turned * np.linalg.norm(forcing.limited, axis=0)).sum())
    return dt_s**2 / 8 * (row_norms(speed @ gain.T) + turned * row_norms(speed) + forced)


def _nonlinear_bend(part_record: RunRecord, x: Reals, u: Reals, dt_s: float) -> Reals:
    """Return Δt²/8 sup‖Kẍ‖ over the steps of a nonlinear plant; infinite if it is not known."""
    loop, scenario = part_record.loop, part_record.scenario
    forced, at_input = np.zeros(loop.n), np.zeros(loop.m)
    if (forcing := bound_forcing(scenario, loop.B)) is not None:
        forced, at_input = np.abs(forcing.limited).sum(axis=1), forcing.at_input
    reach = np.concatenate([np.abs(x).max(axis=0), np.abs(u).max(axis=0) + at_input])
    try:
        return np.full(len(x), enclosed_motion(scenario).bound_bend(loop.K, reach, forced, dt_s))
    except (NotEnclosedError, SystemFailedError):
        return np.full(len(x), math.inf)


def common_end_ns(record: RunRecord) -> int | None:
    """Return the latest time that every process of a stopped run reached.

    None if the run was not stopped, or if a process did not report its time.
    """
    reports = [record.reports.get(role, {}) for role in LOOP_ROLES]
    if all(report.get("ended") == HORIZON for report in reports):
        return None
    reached_ns = [report.get("reached_ns") for report in reports]
    known_ns = [int(t_ns) for t_ns in reached_ns if t_ns is not None]
    measured_ns = record.last_ns(SENSOR_MEASUREMENT)
    if len(known_ns) < len(reports) or measured_ns is None:
        return None
    # A sensor has no deadlines, so its time is that of its last measurement.
    return int(min(*known_ns, measured_ns))


def up_to_common_end(record: RunRecord) -> RunRecord:
    """Return the record of a run up to its common end; the record itself if it has none.

    The rows of each process are cut at its first row beyond that time, in all tables.
    """
    end_ns = common_end_ns(record)
    if end_ns is None:
        return record
    before: dict[str, int] = {}
    for role, table in STEP_TABLES.items():
        column = "now_ns" if role == "netem" else "t_ns"
        later = (rows["input"][rows[column] > end_ns] for rows in record.source.batches(table))
        first = next(filter(len, later), None)
        before[role] = int(np.iinfo(np.int64).max if first is None else first[0])

    def derive(table: str, rows: Rows) -> Rows:
        if table in CLOCK_TABLES:  # their rows have numbers of their own
            return rows.compress(rows["t_ns"] <= end_ns)
        return rows.compress(rows["input"] < before[OWNER[table]])

    return record.derived(record.scenario, derive)
