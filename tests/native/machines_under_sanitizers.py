"""Random machines, for a core that is built with sanitizers; test_sanitized.py runs it in a child.

Their states, matrices, times and numbers are any that the core's checks admit.
"""

from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from noack.core.core_library import LIBRARY, core, load_core
from noack.protocol.wire_format import Flow, Message
from tests.machine_parts import SteppedMachines
from tests.noack.machines.any_machines import (
    MS,
    Sizes,
    controller,
    plant,
    sensor,
    set_number,
    sizes,
    text_of,
)
from tests.wire_decoder import NO_VECTOR

TIMES_NS, NUMBERS = 2**62, 2**63
"""Times and numbers of messages are less."""
VALUES = (0.0, -0.0, 1.0, -3.7, 1e154, 1e308, -1e308, 5e-324, np.inf, -np.inf, np.nan)
WHOLE = (0, 1, -1, 7, MS, 2**40, 2**60, 2**61, 2**62 - 1, 2**62, 2**63 - 1, -(2**63))
"""Some of them are admitted."""

_MACHINE = tuple(
    f"machine.{name}"
    for name in ("phase_ns", "first_ns", "period_ns", "horizon_ns", "step", "inputs",
                 "first_number", "reached_ns", "change_ns")
)  # fmt: skip
NUMBERS_OF = {
    "plant": (
        *_MACHINE, "input_period_ns", "timeout_ns", "notice_ns", "newest_ns", "newest_sequence",
        "fallback_ns", "fallback_sequence", "missing_ns", "measurements", "watchdog",
    ),
    "sensor": (
        *_MACHINE, "timeout_ns", "model_ns", "knows_state", "events", "wait_ns", "rule.from_event",
        "rule.integrates", "rule.is_dynamic", "rule.forecasts", "rule.grid_ns", "rule.idle_ns",
        "rule.shortest_ns", "rule.longest_ns", "trigger.since_ns", "trigger.earliest_ns",
        "trigger.latest_ns", "trigger.measured_ns", "trigger.event_ns",
    ),
    "controller": (*_MACHINE, "model_ns", "knows_state", "newest", "acknowledges"),
}  # fmt: skip
"""Fields that are no sizes of arrays."""
REALS = (
    *(f"rule.{name}" for name in (
        "level", "rate_per_s", "floor", "decay_per_s", "initial", "beta", "alpha_per_s",
        "forecast_floor", "growth_per_s", "mismatch_per_s", "disturbance_per_s",
    )),
    "trigger.level", "trigger.auxiliary", "trigger.rate",
)  # fmt: skip
"""Of a sensor."""

roles = st.sampled_from(["plant", "sensor", "controller"])
scales = st.sampled_from([0.0, 1.0, 1e3, 1e150, 1e308])
times_ns = st.one_of(st.integers(0, 10**9), st.sampled_from([0, TIMES_NS - 1]),
                     st.integers(0, TIMES_NS - 1))  # fmt: skip
numbers = st.one_of(st.integers(0, 100), st.sampled_from([NUMBERS - 1, 2**40, 2**40 + 1]),
                    st.integers(0, NUMBERS - 1))  # fmt: skip
inputs = st.lists(
    st.one_of(
        times_ns,
        st.tuples(st.integers(0, 2), st.booleans(), numbers, times_ns, st.integers(0, 2**32)),
    ),
    max_size=40,
)
"""Ticks that are so late, and messages: loop, whether of the other flow, number, time, seed."""


def test_this_is_another_core_than_noacks() -> None:
    assert core.noack_sources != load_core(LIBRARY).noack_sources


def machines_of(
    role: str, loops: list[tuple[Sizes, int]], scale: float, **more: Any
) -> SteppedMachines:
    """Machines of these sizes and seeds, whose vectors and matrices have this scale."""
    with np.errstate(all="ignore"):
        parts: list[Any] = [
            sensor(seed, of, form=seed, scale=scale) if role == "sensor"
            else controller(seed, of, scale) if role == "controller"
            else plant(seed, of, min(scale, 1e3))  # others are refused before
            for of, seed in loops
        ]  # fmt: skip
        own = SteppedMachines(parts, **more)
        for one in own.machines:
            if role == "plant":
                one.x[0] *= scale
    return own


def drive(own: SteppedMachines, given_inputs: list[Any]) -> None:
    """Give machines their inputs; an observer's measurements are at most 100 steps apart."""
    for item in given_inputs:
        if isinstance(item, int):
            due_ns = own.next_deadline_ns()
            if due_ns is not None:
                own.on_timer(min(due_ns + item, TIMES_NS - 1))
            continue
        loop, other, number, t_ns, seed = item
        loop %= len(own.parts)
        one, rng = own.machines[loop], np.random.default_rng(seed)
        if other and own.parts[loop].shape.acknowledged and own.role.name == "sensor":
            sent = one.sent[0] if one.sent_count and seed % 2 else number
            own.handle(Message(Flow.ACKNOWLEDGEMENT, sent, t_ns, NO_VECTOR, loop), t_ns)
            continue
        if own.role.name == "sensor" and one.observer.kind:
            t_ns = min(max(one.observer.t_ns, 0) + t_ns % (1000 * MS), TIMES_NS - 1)
        vector = rng.choice(VALUES, one.machine.received.entries)
        if seed % 4:
            vector = rng.uniform(-1, 1, len(vector))
        own.handle(Message(own.role.receives, number, t_ns, vector, loop), t_ns)


@settings(max_examples=80)
@given(
    roles, st.lists(st.tuples(sizes(), st.integers(0, 2**16)), min_size=1, max_size=3), scales,
    st.sampled_from([1, 5, 1024]), inputs,
)  # fmt: skip
def test_random_machines(
    role: str, loops: list[tuple[Sizes, int]], scale: float, rows: int, given_inputs: list[Any]
) -> None:
    with np.errstate(all="ignore"):
        drive(machines_of(role, loops, scale, rows=rows), given_inputs)


@settings(max_examples=15)
@given(roles, sizes(64), st.integers(0, 2**16), inputs)
def test_large_machines(role: str, of: Sizes, seed: int, given_inputs: list[Any]) -> None:
    with np.errstate(all="ignore"):
        drive(machines_of(role, [(of, seed)], 1e308), given_inputs)


@settings(max_examples=150)
@given(roles, sizes(3), st.integers(0, 2**16), inputs, st.data())
def test_machines_of_any_numbers_are_refused_or_run_clean(
    role: str, of: Sizes, seed: int, given_inputs: list[Any], data: st.DataObject
) -> None:
    own = machines_of(role, [(of, seed)], 1.0)
    changed = st.tuples(st.sampled_from(NUMBERS_OF[role]), st.sampled_from(WHOLE))
    for name, value in data.draw(st.lists(changed, max_size=3)):
        set_number(own, name, value)
    if role == "sensor":
        changed_reals = st.tuples(st.sampled_from(REALS), st.sampled_from(VALUES))
        for name, real in data.draw(st.lists(changed_reals, max_size=3)):
            set_number(own, name, real)
    if text_of(own) is not None:
        return
    core.noack_process_begin(own.core)
    with np.errstate(all="ignore"):
        drive(own, given_inputs)
