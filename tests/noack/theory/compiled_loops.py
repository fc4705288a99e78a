"""The steps of many runs of a lossy loop, compiled; independent of the project's code.

Signals are rows, so all matrices are transposed. :mod:`tests.noack.theory.loops` has the loops.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from noack.plants.systems.code_cache import CALLED_BY_CODE, cache_folder, compiler

COMPILED = compiler(cache_folder("tests", [Path(__file__)]))
"""Its lock keeps two processes of the tests from compiling the same."""
PART = njit(**CALLED_BY_CODE)
Reals = NDArray[np.float64]
Flags = NDArray[np.bool_]
Steps = NDArray[np.int64]


class Schedule(NamedTuple):
    """The times of a loop, in steps."""

    known_start: bool
    sample: int
    hold: int
    lag: int


class Propagators(NamedTuple):
    """Matrices over one step; the first index of a plant's is its number in the pool."""

    K: Reals
    """(n, m)"""
    weight: Reals
    both: Reals
    """(plants, 2n, n): x of u = K x_c, from x and x_c."""
    held: Reals
    """(plants, n + m, n): x of a held input, from x and u."""
    free: Reals
    """(plants, n, n): x without an input."""
    pushed: Reals
    """(plants, n, n): x of a constant disturbance of ẋ."""
    model: Reals
    late: Reals
    """(delays, n, n): the models' propagators over the delay of an update."""


class State(NamedTuple):
    """All runs between two steps; the last index is the run."""

    x: Reals
    """(n, runs)"""
    x_s: Reals
    x_c: Reals
    arriving: Reals
    """(slots, n, runs) an update in flight, as its value on arrival."""
    arrives: Steps
    """(slots, runs) number of the update, from 1; 0: none."""
    newest: Steps
    events: Steps
    last_event: Steps
    synchronised: Flags
    commands: Reals
    """(steps, m, runs)"""
    commanded: Flags
    """(steps, runs) whether there is a command."""


class Given(NamedTuple):
    """What does not depend on the state."""

    threshold: Reals
    """(steps,)"""
    delivered: Flags
    """(runs, events)"""
    delays: Steps
    """(runs, events)"""
    plants: Steps
    """(steps, runs) number of the plant in the pool; or (0, 0) for the only one."""
    pushes: Reals
    """(steps, n, runs); or (0, 0, 0) for none."""


class Seen(NamedTuple):
    """The results."""

    trace: Reals
    """(5, steps, runs)"""
    inputs: Reals
    """(steps, m, runs)"""
    shortest: Steps
    """(runs,) the shortest inter-event time in steps."""
    states: Reals
    """(2, steps, n, runs): x, and what the sensor knows of it."""
    is_event: Flags
    """(steps, runs)"""
    received: Steps
    """(steps, runs) number of the newest update that has arrived."""


@PART
def add_product(total: Reals, v: Reals, matrix: Reals, first: int) -> None:
    """Add v M, of the rows of M from ``first`` on; v and the total have shapes (n, runs)."""
    for j in range(total.shape[0]):
        for i in range(v.shape[0]):
            factor = matrix[first + i, j]
            for run in range(v.shape[1]):
                total[j, run] += factor * v[i, run]


@PART
def distances(found: Reals, v: Reals, w: Reals, matrix: Reals) -> None:
    """Set ‖(v − w) M‖, (runs,); v and w have the shapes (n, runs)."""
    rest, found[:] = np.empty_like(found), 0.0
    for j in range(matrix.shape[1]):
        rest[:] = 0.0
        for i in range(v.shape[0]):
            factor = matrix[i, j]
            for run in range(v.shape[1]):
                rest[run] += factor * (v[i, run] - w[i, run])
        for run in range(v.shape[1]):
            found[run] += rest[run] * rest[run]
    for run in range(v.shape[1]):
        found[run] = np.sqrt(found[run])


@COMPILED
def follow(
    first: int, last: int, schedule: Schedule, own: Propagators, given: Given, state: State,
    seen: Seen, known: Reals, event: Flags,
) -> None:  # fmt: skip
    """Simulate the steps first … last − 1 of all runs, in place.

    ``known``, (n, runs), is what the sensor knows of x at the step ``first``; (n, 0): x. ``event``
    says which runs have an event then; (0,): those above the threshold.
    """
    x, x_s, x_c, trace = state.x, state.x_s, state.x_c, seen.trace
    size, everything = np.empty(x.shape[1]), np.eye(len(x))
    nothing, has_input = np.zeros_like(x), np.zeros(x.shape[1], dtype=np.bool_)
    for step in range(first, last):
        estimate = known if step == first and known.size else x
        distances(trace[0, step], x_s, x, own.weight)
        if step % schedule.sample == 0:
            distances(size, x_s, estimate, own.weight)
            for run in range(len(size)):
                trace[0, step, run] = max(trace[0, step, run], size[run])
                goes = event[run] if len(event) else size[run] > given.threshold[step]
                if goes or (step == 0 and not schedule.known_start):
                    _send(run, step, own, given, state, seen, estimate)
        _deliver(step % len(state.arrives), state)
        seen.states[0, step], seen.states[1, step] = x, estimate
        seen.received[step] = state.newest
        _command(step, schedule, own, state)
        u, has_input[:] = seen.inputs[step], False
        if step >= schedule.lag:
            has_input[:] = state.commanded[step - schedule.lag]
            u[:] = state.commands[step - schedule.lag] * has_input
        distances(trace[1, step], x_c, x, own.weight)
        distances(size, x_c, estimate, own.weight)
        trace[1, step] = np.maximum(trace[1, step], size) * state.synchronised
        distances(trace[2, step], x, nothing, everything)
        distances(trace[3, step], x, nothing, own.weight)
        gap = u.copy()
        add_product(gap, x, -own.K, 0)
        trace[4, step] = np.sqrt((gap * gap).sum(axis=0)) * has_input
        _advance(step, schedule, own, given, state, u, has_input)


@PART
def _send(
    run: int, step: int, own: Propagators, given: Given, state: State, seen: Seen, estimate: Reals
) -> None:
    """Let an event happen: x_s is reset, and an update is lost or in flight."""
    number = state.events[run]
    if number > 0:
        seen.shortest[run] = min(seen.shortest[run], step - state.last_event[run])
    state.x_s[:, run] = estimate[:, run]
    state.last_event[run], seen.is_event[step, run] = step, True
    if given.delivered[run, number]:
        delay = given.delays[run, number]
        slot = (step + delay) % len(state.arrives)
        for j in range(len(estimate)):
            value = 0.0
            for i in range(len(estimate)):
                value += estimate[i, run] * own.late[delay, i, j]
            state.arriving[slot, j, run] = value
        state.arrives[slot, run] = number + 1
    state.events[run] = number + 1


@PART
def _deliver(slot: int, state: State) -> None:
    """Let the updates arrive that are due; an older one than the newest is discarded."""
    for run in range(len(state.newest)):
        if state.arrives[slot, run] > state.newest[run]:
            state.x_c[:, run] = state.arriving[slot, :, run]
            state.newest[run] = state.arrives[slot, run]
            state.synchronised[run] = True
        state.arrives[slot, run] = 0


@PART
def _command(step: int, schedule: Schedule, own: Propagators, state: State) -> None:
    """Note the controller's command of this step."""
    if schedule.hold == 0 or step % schedule.hold == 0:
        add_product(state.commands[step], state.x_c, own.K, 0)
        state.commanded[step] = state.synchronised
    else:
        state.commands[step] = state.commands[step - 1]
        state.commanded[step] = state.commanded[step - 1]


@PART
def _advance(
    step: int, schedule: Schedule, own: Propagators, given: Given, state: State, u: Reals,
    has_input: Flags,
) -> None:  # fmt: skip
    """Propagate x, x_s and x_c over one step; u = K x_c changes with x_c unless it is held."""
    x, x_s, x_c = state.x, state.x_s, state.x_c
    n = len(x)
    following = np.zeros_like(x)
    for plant in range(len(own.free)):
        moved = np.zeros_like(x)
        if schedule.hold > 0:
            add_product(moved, x, own.held[plant], 0)
            add_product(moved, u, own.held[plant], n)
        elif has_input.any():
            add_product(moved, x, own.both[plant], 0)
            add_product(moved, x_c, own.both[plant], n)
        if schedule.hold == 0 and not has_input.all():
            free = np.zeros_like(x)
            add_product(free, x, own.free[plant], 0)
            moved = np.where(has_input, moved, free)
        if len(given.pushes):
            add_product(moved, given.pushes[step], own.pushed[plant], 0)
        if len(own.free) == 1:
            following = moved
        else:
            following += np.where(given.plants[step] == plant, moved, 0.0)
    x[:] = following
    for models in (x_s, x_c):
        moved = np.zeros_like(x)
        add_product(moved, models, own.model, 0)
        models[:] = moved


@COMPILED
def allow(lost: Flags, mansd: int, most: int, width: int, recovery: int) -> None:
    """Deliver what the guarantee does not allow to be lost, (runs, events), in place."""
    for run in range(lost.shape[0]):
        burst, since = 0, recovery
        for event in range(lost.shape[1]):
            if lost[run, event]:
                recent = lost[run, max(event - width + 1, 0) : event].sum()
                if burst >= mansd or recent >= most or (burst == 0 and since < recovery):
                    lost[run, event] = False
            if lost[run, event]:
                burst, since = burst + 1, 0
            else:
                burst, since = 0, since + 1
