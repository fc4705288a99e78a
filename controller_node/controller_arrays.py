"""The controllers of many loops in arrays: what :class:`Controller` does, compiled.

The law is u = K(x_c − x_r) + u_r. Losses are compared with the guarantee from the rows.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from controller_node.loss_check import LossCheck
from noack.config.fleet_layout import (
    HEADER_WORDS,
    NEEDS_MATRIX,
    NEVER_NS,
    SENDS,
    FleetMemory,
    FleetParts,
    FleetRole,
    begin_message,
    begin_row,
    copy_reals,
)
from noack.config.parameter_changes import ChangeSchedule
from noack.config.resolution import loop_of
from noack.config.scenario import Scenario
from noack.controllers.linear_feedback import LinearFeedbackSettings
from noack.core.linear_systems import Vector
from noack.core.model_arrays import (
    MISSING,
    ModelTable,
    Transitions,
    advance_model,
    find_transition,
)
from noack.core.ordered_arithmetic import multiply
from noack.impairments.loss_guarantee import LongestBurst
from noack.protocol.machine_interface import Notice
from noack.protocol.record_tables import CONTROLLER_DELIVERY, CONTROLLER_SETTING, CONTROLLER_STEP

CONTROLLER = np.dtype(
    [(name, "<i8") for name in (
        "period_ns", "first_ns", "horizon_ns", "step", "model_ns", "newest", "knows_state",
    )]
)  # fmt: skip


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
    steps_ns = set[int]()
    controllers = np.zeros(len(loops), CONTROLLER)
    for place, one in enumerate(resolved):
        row = controllers[place]
        period_ns, first_ns = one.timing.controller_period_ns, one.timing.controller_phase_ns
        steps_ns |= {period_ns, first_ns, period_ns - first_ns}
        row["period_ns"], row["first_ns"] = period_ns, first_ns
        row["horizon_ns"], row["newest"] = one.timing.horizon_ns, -1
        row["knows_state"] = one.network.initial_sync == "known_state"
    transitions = Transitions(
        [loop.H for loop in loops], [loop.setpoint for loop in loops], sorted(steps_ns)
    )
    known = controllers["knows_state"]
    arrays = ControllerArrays(
        controllers=controllers,
        x_c=np.concatenate(
            [loop.x0 if knows else np.zeros(n) for loop, knows in zip(loops, known, strict=True)]
        ),
        K=np.concatenate([loop.K.ravel() for loop in loops]),
        u_r=np.concatenate(
            [np.zeros(m) if (u_r := loop.setpoint_input) is None else u_r for loop in loops]
        ),
        safe_input=np.concatenate(
            [
                np.zeros(m) if (given := one.controller.safe_input) is None else np.array(given)
                for one in resolved
            ]
        ),
        models=transitions.table,
    )
    firsts_ns = controllers["first_ns"]
    due_ns = np.where(firsts_ns <= controllers["horizon_ns"], firsts_ns, NEVER_NS)
    checks = _LossChecks(resolved)
    return FleetParts(
        arrays, due_ns, transitions, inspect=checks, changes=CONTROLLER_SETTING,
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
    before = find_transition(own.models, loop, model_ns - one.model_ns)
    if before == MISSING:
        return NEEDS_MATRIX
    after = find_transition(own.models, loop, model_ns - event_ns)
    if after == MISSING:
        return NEEDS_MATRIX
    begin_row(memory, loop, sequence, event_ns, now_ns)
    memory.row[4] = model_ns
    copy_reals(memory.arrived_reals, begin + HEADER_WORDS, row, 5, n)
    advance_model(own.models, loop, n, before, own.x_c, loop * n, row, 5 + n)
    advance_model(own.models, loop, n, after, row, 5, own.x_c, loop * n)
    copy_reals(own.x_c, loop * n, row, 5 + 2 * n, n)
    memory.row[5 + 3 * n] = sequence - one.newest - 1
    one.model_ns = model_ns
    one.newest = sequence
    one.knows_state = 1
    return 0


def on_timer(memory: FleetMemory, own: ControllerArrays, loop: int, now_ns: int) -> int:
    """Advance x_c to the tick and write the control input."""
    one, fleet, row = own.controllers[loop], memory.fleet[0], memory.row_reals
    n, m, t_ns = fleet.n, fleet.m, one.first_ns + one.step * one.period_ns
    if t_ns > one.model_ns:
        found = find_transition(own.models, loop, t_ns - one.model_ns)
        if found == MISSING:
            return NEEDS_MATRIX
        advance_model(own.models, loop, n, found, own.x_c, loop * n, memory.scratch, 0)
        copy_reals(memory.scratch, 0, own.x_c, loop * n, n)
        one.model_ns = t_ns
    begin_row(memory, loop, one.step, t_ns, now_ns)
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
    copy_reals(row, u, memory.out_reals, begin_message(memory, one.step, one.model_ns), m)
    one.step += 1
    due_ns = t_ns + one.period_ns
    memory.loops[loop].due_ns = due_ns if due_ns <= one.horizon_ns else NEVER_NS
    return SENDS


CONTROLLER_FLEET = FleetRole(__name__, CONTROLLER_DELIVERY, CONTROLLER_STEP, controller_arrays_of)
