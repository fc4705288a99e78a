"""The controllers of many loops in arrays: what :class:`Controller` does, compiled.

The law is u = K(x_c − x_r) + u_r. Losses are compared with the guarantee from the rows.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from controller_node.loss_check import LossCheck
from noack.config import fleet_layout as layout
from noack.config.fleet_layout import FleetMemory, FleetParts, FleetRole, copy_reals
from noack.config.parameter_changes import ChangeSchedule
from noack.config.resolution import loop_of
from noack.config.scenario import Scenario
from noack.controllers.linear_feedback import LinearFeedbackSettings
from noack.core.linear_systems import Vector
from noack.core.model_arrays import ModelTable, Transitions, advance_model, joined
from noack.core.ordered_arithmetic import multiply
from noack.impairments.loss_guarantee import LongestBurst
from noack.protocol.machine_interface import Notice
from noack.protocol.record_tables import CONTROLLER_DELIVERY, CONTROLLER_SETTING, CONTROLLER_STEP

CONTROLLER = np.dtype([(name, "<i8") for name in ("model_ns", "newest", "knows_state")])


class ControllerArrays(NamedTuple):
    """The state of L controllers."""

    controllers: NDArray[Any]
    """(L,) :data:`CONTROLLER`."""
    x_c: Vector
    """(L n,)"""
    K: Vector
    """(L m n,)"""
    u_r: Vector
    """(L m,)"""
    safe_input: Vector
    """(L m,)"""
    models: ModelTable


def controller_arrays_of(resolved: Sequence[Scenario]) -> FleetParts | None:
    """Return the controllers of resolved scenarios; None if one cannot be compiled."""
    if any(
        not isinstance(one.controller, LinearFeedbackSettings)
        or one.protocol.acknowledges
        or one.message_sizes.is_predictive
        or one.controller.predictions > 1
        for one in resolved
    ):
        return None
    loops = [loop_of(one) for one in resolved]
    n, m = loops[0].n, loops[0].m
    ticks_ns = [
        (one.timing.controller_phase_ns, one.timing.controller_period_ns) for one in resolved
    ]
    controllers = np.zeros(len(loops), CONTROLLER)
    known = [one.network.initial_sync == "known_state" for one in resolved]
    controllers["newest"], controllers["knows_state"] = -1, known
    transitions = Transitions(
        [loop.H for loop in loops],
        [loop.setpoint for loop in loops],
        {step for first, period in ticks_ns for step in (first, period, period - first)},
    )
    arrays = ControllerArrays(
        controllers=controllers,
        x_c=joined((loops[k].x0 if knows else None for k, knows in enumerate(known)), n),
        K=joined((loop.K for loop in loops), m * n),
        u_r=joined((loop.setpoint_input for loop in loops), m),
        safe_input=joined((one.controller.safe_input for one in resolved), m),
        models=transitions.table,
    )
    begun, checks = layout.new_loops(resolved, ticks_ns), _LossChecks(resolved)
    return FleetParts(
        arrays, begun, transitions, inspect=checks, changes=CONTROLLER_SETTING,
        follow=checks.follow,
    )  # fmt: skip


class _LossChecks:
    """Compares the losses of each loop with the guarantee, from rows of deliveries."""

    def __init__(self, resolved: Sequence[Scenario]) -> None:
        self._checks = [
            LossCheck(
                one.network.guarantee, None,
                known_start=one.network.initial_sync == "known_state",
            )
            for one in resolved
        ]  # fmt: skip
        self._all = any(
            not isinstance(rule, LongestBurst)
            for one in resolved
            for rule in one.network.guarantee.rules
        )

    def follow(self, schedule: ChangeSchedule, phases_ns: Sequence[int]) -> None:
        """Use the announced changes of the network; from now on, every row counts."""
        self._all = True
        for check, phase_ns in zip(self._checks, phases_ns, strict=True):
            check.follow(schedule, phase_ns)

    def __call__(self, rows: NDArray[np.void]) -> Sequence[tuple[int, Notice]]:
        """Return the violations, each with its loop."""
        if not self._all:
            rows = rows[rows["dropouts"] > 0]
        names = ("loop", "sequence", "dropouts", "t_ns", "now_ns", "model_t_ns")
        found: list[tuple[int, Notice]] = []
        for loop, sequence, losses, t_ns, now_ns, model_ns in zip(
            *(rows[name].tolist() for name in names), strict=True
        ):
            check = self._checks[loop]
            check.reach(model_ns)
            notices = check.add(sequence, sequence - losses - 1, losses, t_ns, now_ns)
            found += [(loop, notice) for notice in notices]
        return found


def handle(memory: FleetMemory, own: ControllerArrays, loop: int, begin: int, now_ns: int) -> int:
    """Process the update whose datagram begins at ``begin``."""
    one, n, row = own.controllers[loop], memory.fleet[0].n, memory.row_reals
    sequence, event_ns = memory.arrived[begin + 2], memory.arrived[begin + 3]
    model_ns = max(one.model_ns, event_ns)
    copy_reals(memory.arrived_reals, begin + layout.HEADER_WORDS, row, 5, n)
    before, after, models = 5 + n, 5 + 2 * n, own.models
    if not advance_model(
        models, loop, n, model_ns - one.model_ns, own.x_c, loop * n, row, before
    ) or not advance_model(models, loop, n, model_ns - event_ns, row, 5, row, after):
        return layout.NEEDS_MATRIX
    layout.begin_row(memory, loop, sequence, event_ns, now_ns)
    memory.row[4] = model_ns
    copy_reals(row, after, own.x_c, loop * n, n)
    memory.row[5 + 3 * n] = sequence - one.newest - 1
    one.model_ns = model_ns
    one.newest = sequence
    one.knows_state = 1
    return 0


def on_timer(memory: FleetMemory, own: ControllerArrays, loop: int, now_ns: int) -> int:
    """Advance x_c to the tick and write the control input."""
    one, tick, row = own.controllers[loop], memory.loops[loop], memory.row_reals
    n, m, t_ns, step = memory.fleet[0].n, memory.fleet[0].m, tick.due_ns, tick.step
    if t_ns > one.model_ns:
        dt_ns = t_ns - one.model_ns
        if not advance_model(own.models, loop, n, dt_ns, own.x_c, loop * n, memory.scratch, 0):
            return layout.NEEDS_MATRIX
        copy_reals(memory.scratch, 0, own.x_c, loop * n, n)
        one.model_ns = t_ns
    layout.begin_row(memory, loop, step, t_ns, now_ns)
    memory.row[4] = one.model_ns
    copy_reals(own.x_c, loop * n, row, 5, n)
    u, shifts = 5 + n, own.models.has_setpoint[loop] != 0
    if one.knows_state == 0:
        copy_reals(own.safe_input, loop * m, row, u, m)
    else:
        for k in range(n):
            memory.scratch[k] = own.x_c[loop * n + k]
            if shifts:
                memory.scratch[k] -= own.models.setpoint[loop * n + k]
        multiply(own.K, loop * m * n, memory.scratch, 0, row, u, (m, n))
        if shifts:
            for k in range(m):
                row[u + k] += own.u_r[loop * m + k]
    layout.write_message(memory, step, one.model_ns, row, u, m)
    layout.next_tick(memory, loop)
    return layout.SENDS


CONTROLLER_FLEET = FleetRole(__name__, CONTROLLER_DELIVERY, CONTROLLER_STEP, controller_arrays_of)
