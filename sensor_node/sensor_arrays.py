"""The sensors of many loops in arrays: what :class:`sensor_node.sensor.Sensor` does, compiled."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.config import fleet_layout as layout
from noack.config.fleet_layout import FleetMemory, FleetParts, FleetRole, copy_reals
from noack.config.resolution import loop_of, policy_of
from noack.config.scenario import Scenario
from noack.core.linear_systems import Vector
from noack.core.model_arrays import ModelTable, Transitions, advance_model, joined
from noack.protocol.record_tables import NO_SEQUENCE, SENSOR_MEASUREMENT, SENSOR_SETTING
from noack.trigger.trigger_arrays import (
    TRIGGER,
    has_array_form,
    is_event,
    set_rule,
    start_condition,
    weighted_norm,
)
from noack.trigger.trigger_policy import CodedPolicy

SENSOR = np.dtype([(name, "<i8") for name in ("model_ns", "events", "knows_state")])


class SensorArrays(NamedTuple):
    """The state of L sensors."""

    sensors: NDArray[Any]
    """(L,) :data:`SENSOR`."""
    x_s: Vector
    """(L n,)"""
    triggers: NDArray[Any]
    """(L,) :data:`noack.trigger.trigger_arrays.TRIGGER`."""
    matrices: Vector
    """The matrices of the triggers."""
    z: Vector
    """(2n,) Scratch."""
    model: Vector
    """(n,) Scratch."""
    sides: Vector
    """(2,) Scratch."""
    models: ModelTable


def sensor_arrays_of(resolved: Sequence[Scenario]) -> FleetParts | None:
    """Return the sensors of resolved scenarios; None if one cannot be compiled."""
    loops = [loop_of(one) for one in resolved]
    policies = [policy_of(one) for one in resolved]
    n = loops[0].n
    if any(isinstance(policy, CodedPolicy) for policy in policies):
        return None
    rules = [policy.trigger_rule(n) for policy in policies]
    if not all(map(has_array_form, rules)) or any(
        one.observer is not None or one.protocol.acknowledges for one in resolved
    ):
        return None
    triggers, matrices = np.zeros(len(loops), TRIGGER), list[float]()
    for trigger, rule, policy in zip(triggers, rules, policies, strict=True):
        set_rule(trigger, rule, policy.weight, matrices)
    transitions = Transitions(
        [loop.H for loop in loops],
        [loop.setpoint for loop in loops],
        {one.timing.measurement_period_ns for one in resolved},
    )
    known = [one.network.initial_sync == "known_state" for one in resolved]
    sensors = np.zeros(len(loops), SENSOR)
    sensors["knows_state"] = known
    arrays = SensorArrays(
        sensors=sensors,
        x_s=joined((loop.x0 for loop in loops), n),
        triggers=triggers,
        matrices=np.array([*matrices, 0.0]),
        z=np.zeros(2 * n),
        model=np.zeros(n),
        sides=np.zeros(2),
        models=transitions.table,
    )
    scratch, rows = np.zeros(layout.SCRATCH), triggers.view(np.recarray)
    for number in np.flatnonzero(known).tolist():
        start_condition(
            rows[number], arrays.matrices, 0, arrays.x_s, number * n, n, arrays.z, scratch
        )
    return FleetParts(arrays, layout.new_loops(resolved), transitions, changes=SENSOR_SETTING)


def handle(memory: FleetMemory, own: SensorArrays, loop: int, begin: int, now_ns: int) -> int:
    """Process the measurement whose datagram begins at ``begin``."""
    sensor, trigger, n = own.sensors[loop], own.triggers[loop], memory.fleet[0].n
    sequence, t_ns = memory.arrived[begin + 2], memory.arrived[begin + 3]
    measured, x_s, at, z = memory.arrived_reals, own.model, begin + layout.HEADER_WORDS, own.z
    first = sensor.knows_state == 0
    if first:
        copy_reals(measured, at, x_s, 0, n)
        start_condition(trigger, own.matrices, t_ns, measured, at, n, z, memory.scratch)
    elif not advance_model(own.models, loop, n, t_ns - sensor.model_ns, own.x_s, loop * n, x_s, 0):
        return layout.NEEDS_MATRIX
    for k in range(n):
        z[k] = measured[at + k]
        z[n + k] = x_s[k] - measured[at + k]
    event = is_event(trigger, own.matrices, t_ns, n, z, 0.0, own.sides, memory.scratch)
    event = event or first
    layout.begin_row(memory, loop, sequence, t_ns, now_ns)
    copy_reals(measured, at, memory.row_reals, 4, n)
    copy_reals(x_s, 0, memory.row_reals, 4 + n, n)
    place = 4 + 2 * n
    memory.row_reals[place] = weighted_norm(trigger, own.matrices, z, n, n, memory.scratch)
    memory.row_reals[place + 1] = own.sides[0]
    memory.row_reals[place + 2] = own.sides[1]
    memory.row[place + 3] = sensor.events if event else NO_SEQUENCE
    sensor.model_ns = t_ns
    sensor.knows_state = 1
    if not event:
        copy_reals(x_s, 0, own.x_s, loop * n, n)
        return 0
    start_condition(trigger, own.matrices, t_ns, measured, at, n, z, memory.scratch)
    copy_reals(measured, at, own.x_s, loop * n, n)
    layout.write_message(memory, sensor.events, t_ns, measured, at, n)
    sensor.events += 1
    return layout.SENDS


def on_timer(memory: FleetMemory, own: SensorArrays, loop: int, now_ns: int) -> int:
    """Nothing is ever due."""
    return 0


SENSOR_FLEET = FleetRole(__name__, SENSOR_MEASUREMENT, None, sensor_arrays_of)
