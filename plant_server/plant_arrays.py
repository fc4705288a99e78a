"""The plants of many loops in arrays: what :class:`plant_server.plant.Plant` does, compiled.

The plants are linear and without disturbance or noise; the input is held.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.config import fleet_layout as layout
from noack.config.fleet_layout import FleetMemory, FleetParts, FleetRole, copy_reals
from noack.config.resolution import loop_of
from noack.config.scenario import Scenario
from noack.core.linear_systems import Vector, discretise
from noack.core.model_arrays import joined
from noack.core.ordered_arithmetic import multiply
from noack.plants.linear import LinearSettings
from noack.protocol.machine_interface import Notice
from noack.protocol.record_tables import NO_SEQUENCE, PLANT_ACTUATION, PLANT_STEP
from plant_server.measurement import measurement_model_of
from plant_server.watchdog import FALLBACK_NAMES, are_missing, arrive_again

_IN_TIME = -1
_ZERO = 1

PLANT = np.dtype(
    [(name, "<i8") for name in (
        "measure_every", "measurements", "newest_ns", "newest_sequence", "timeout_ns",
        "notice_ns", "policy",
        "noticed_ns",  # since when actuations have been reported missing; _IN_TIME: they are not
    )]
)  # fmt: skip


class PlantArrays(NamedTuple):
    """The state of L plants."""

    plants: NDArray[Any]
    """(L,) :data:`PLANT`."""
    x: Vector
    """(L n,)"""
    u: Vector
    """(L m,) The applied inputs."""
    newest_u: Vector
    """(L m,) The newest actuations."""
    Ad: Vector
    """(L n n,)"""
    Bd: Vector
    """(L n m,)"""


def plant_arrays_of(resolved: Sequence[Scenario]) -> FleetParts | None:
    """Return the plants of resolved scenarios; None if one cannot be compiled."""
    if any(
        not isinstance(one.plant.system, LinearSettings)
        or one.plant.disturbances
        or one.observer is not None
        or one.controller.predictions > 1
        or measurement_model_of(one) is not None
        or one.plant.watchdog.policy not in ("hold", "zero")
        for one in resolved
    ):
        return None
    loops = [loop_of(one) for one in resolved]
    plants = np.zeros(len(loops), PLANT)
    for row, one in zip(plants, resolved, strict=True):
        row["measure_every"] = one.plant.measure_every
        row["timeout_ns"] = one.timing.actuation_timeout_ns
        row["notice_ns"] = max(one.timing.missing_actuation_ns, one.timing.actuation_timeout_ns)
        row["policy"] = _ZERO if one.plant.watchdog.policy == "zero" else 0
    plants["newest_sequence"], plants["noticed_ns"] = NO_SEQUENCE, _IN_TIME
    discrete = [
        discretise(loop.A, loop.B, one.timing.plant_period_ns)
        for loop, one in zip(loops, resolved, strict=True)
    ]
    n, m = loops[0].n, loops[0].m
    arrays = PlantArrays(
        plants=plants,
        x=joined((one.plant.initial_state for one in resolved), n),
        u=np.zeros(len(loops) * m),
        newest_u=np.zeros(len(loops) * m),
        Ad=joined((Ad for Ad, _ in discrete), n * n),
        Bd=joined((Bd for _, Bd in discrete), n * m),
    )
    ticks_ns = [(0, one.timing.plant_period_ns) for one in resolved]
    return FleetParts(arrays, layout.new_loops(resolved, ticks_ns), notice=_notice)


def _notice(own: PlantArrays, note: Any) -> Notice:
    plant = own.plants[note["loop"]]
    t_ns, since_ns = int(note["t_ns"]), int(note["since_ns"])
    if since_ns != _IN_TIME:
        return arrive_again(t_ns, since_ns)
    none = note["newest_sequence"] == NO_SEQUENCE
    name = FALLBACK_NAMES["zero" if plant["policy"] == _ZERO else "hold"]
    return are_missing(
        t_ns, int(note["newest_ns"]), int(plant["timeout_ns"]), name, none=bool(none)
    )


def handle(memory: FleetMemory, own: PlantArrays, loop: int, begin: int, now_ns: int) -> int:
    """Receive the actuation whose datagram begins at ``begin``."""
    plant, m = own.plants[loop], memory.fleet[0].m
    plant.newest_sequence, plant.newest_ns = memory.arrived[begin + 2], memory.arrived[begin + 3]
    copy_reals(memory.arrived_reals, begin + layout.HEADER_WORDS, own.newest_u, loop * m, m)
    layout.begin_row(memory, loop, plant.newest_sequence, plant.newest_ns, now_ns)
    copy_reals(own.newest_u, loop * m, memory.row_reals, 4, m)
    return 0


def on_timer(memory: FleetMemory, own: PlantArrays, loop: int, now_ns: int) -> int:
    """Make one step under the held input; measure; choose the input from now on."""
    plant, fleet, tick = own.plants[loop], memory.fleet[0], memory.loops[loop]
    n, m, step, t_ns = fleet.n, fleet.m, tick.step, tick.due_ns
    if step > 0:
        multiply(own.Ad, loop * n * n, own.x, loop * n, memory.scratch, 0, (n, n))
        multiply(own.Bd, loop * n * m, own.u, loop * m, memory.scratch, n, (n, m))
        for k in range(n):
            own.x[loop * n + k] = memory.scratch[k] + memory.scratch[n + k]
    _choose_input(memory, own, loop, t_ns)
    layout.begin_row(memory, loop, step, t_ns, now_ns)
    copy_reals(own.x, loop * n, memory.row_reals, 4, n)
    copy_reals(own.u, loop * m, memory.row_reals, 4 + n, m)
    memory.row[4 + n + m] = plant.newest_sequence
    layout.next_tick(memory, loop)
    if step % plant.measure_every == 0:
        layout.write_message(memory, plant.measurements, t_ns, own.x, loop * n, n)
        plant.measurements += 1
        return layout.SENDS
    return 0


def _choose_input(memory: FleetMemory, own: PlantArrays, loop: int, t_ns: int) -> None:
    """Do what :meth:`plant_server.watchdog.Watchdog.input` does; write a note if it notices."""
    plant, fleet = own.plants[loop], memory.fleet[0]
    is_old = t_ns - plant.newest_ns > plant.timeout_ns
    for k in range(loop * fleet.m, (loop + 1) * fleet.m):
        own.u[k] = 0.0 if is_old and plant.policy == _ZERO else own.newest_u[k]
    is_missing = t_ns - plant.newest_ns > plant.notice_ns
    if is_missing == (plant.noticed_ns != _IN_TIME):
        return
    note = memory.notes[fleet.notes]
    note.loop, note.t_ns, note.since_ns = loop, t_ns, plant.noticed_ns
    note.newest_ns, note.newest_sequence = plant.newest_ns, plant.newest_sequence
    fleet.notes += 1
    plant.noticed_ns = t_ns if is_missing else _IN_TIME


PLANT_FLEET = FleetRole(__name__, PLANT_ACTUATION, PLANT_STEP, plant_arrays_of)
