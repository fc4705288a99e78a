"""Compiled rules and the same rules in Python make the same decisions, bit for bit.

So do their memories of the flows.
"""

from dataclasses import astuple
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from netem.engine.compiled_rules import compile_rule, compiled_program, compiled_state, set_flow
from netem.engine.many_decisions import admit_many
from netem.link_machine import Link
from netem.rule_program import program_of
from netem.rules.settings_change import carry
from netem.words.words_to_settings import settings_of
from noack.impairments.link_records import (
    LinkMemory,
    LinkProgram,
    PacketDecision,
    RecordedDecision,
    array_of,
    dtype_of,
)
from noack.impairments.link_settings import LinkSettings
from tests.netem import any_settings

FLOWS = 4
Batch = list[tuple[int, int, int]]
"""Flow, size, and time of each datagram."""
arrivals = st.lists(
    st.tuples(
        st.integers(0, FLOWS - 1),
        st.integers(0, 2000),
        st.integers(0, 3_000_000) | st.integers(0, 10**7),
    ),
    min_size=1,
    max_size=120,
)
recorded_decisions = st.builds(
    RecordedDecision, fate=st.integers(0, 5), delay_ns=st.integers(-1, 10**7),
    copy_delay_ns=st.just(-1) | st.integers(0, 10**7), bit=st.integers(-1, 9),
    copy_bit=st.integers(-1, 9),
)  # fmt: skip
EVERYTHING = settings_of(
    "loss gemodel 10% 20% 90% duplicate 10% corrupt 10% 50% delay 5ms 3ms distribution "
    "paretonormal lossrel 50% reorder 10% rate 10mbit queue 20 blackout 0.5s-0.6s every 1s "
    "mansd 4 limit 1000000"
)


class Compiled:
    """A link with compiled rules; its rows are not in the order of its flows."""

    def __init__(self, own: LinkSettings, **others: Any) -> None:
        self.program: LinkProgram = compiled_program(plain := program_of(own, 3, "a", **others))
        self.state = compiled_state(plain, FLOWS)
        self._first_delivered = own.first_delivered
        self._seen: set[int] = set()

    def decide(self, batch: Batch) -> list[tuple[Any, ...]]:
        flows, sizes, times = (np.array(column, np.int64) for column in zip(*batch, strict=True))
        for flow in set(flows.tolist()) - self._seen:
            self._seen.add(flow)
            set_flow(self.state, row_of(flow), flow, self._first_delivered)
        decisions = np.zeros(len(batch), dtype_of(PacketDecision))
        rows = np.array([row_of(flow) for flow in range(FLOWS)])[flows]
        compile_rule(admit_many)(self.program, self.state, rows, sizes, times, decisions)
        return [tuple(decision) for decision in decisions.tolist()]

    def change(self, own: LinkSettings) -> None:
        self._first_delivered = own.first_delivered
        plain = program_of(own, 3, "a", tracks=self.program.tracks)
        state: LinkMemory = compiled_state(plain, FLOWS)
        state = state._replace(
            flows=self.state.flows, link=self.state.link, counters=self.state.counters
        )
        program = compiled_program(plain)._replace(
            decisions=self.program.decisions, decisions_begin=self.program.decisions_begin
        )
        compile_rule(carry)(self.program, self.state, program, state, np.full(FLOWS, -1))
        self.program, self.state = program, state


def row_of(flow: int) -> int:
    return FLOWS - 1 - flow


def ascending(batch: Batch) -> Batch:
    times = np.cumsum([gap for _, _, gap in batch]).tolist()
    return [(flow, size, t) for (flow, size, _), t in zip(batch, times, strict=True)]


def check_same(compiled: Compiled, plain: Link, batch: Batch) -> list[tuple[Any, ...]]:
    """Compare the decisions and the link's whole memory; return the decisions."""
    decisions = compiled.decide(batch)
    assert decisions == [astuple(plain.decide(*arrival)) for arrival in batch]
    found: Any = compiled.state
    expected = plain._state
    for flow, row in plain._rows.items():
        own = row_of(flow)
        assert found.flows[own].tolist() == astuple(expected.flows[row])
        assert found.memory[own].tolist() == [*map(astuple, expected.memory[row])]
        for rows, of_plain in (
            (found.recent_ns, expected.recent_ns),
            (found.losses, expected.losses),
        ):
            np.testing.assert_array_equal(rows[own], of_plain[row])
    np.testing.assert_array_equal(found.departures_ns, expected.departures_ns)
    if expected.queues:
        queues = array_of(found.queues.dtype, expected.queues)
        np.testing.assert_array_equal(found.queues, queues)
    assert found.counters.tolist() == astuple(expected.counters)
    assert found.link.tolist() == astuple(expected.link)
    return decisions


@settings(max_examples=150)
@given(
    own=any_settings.harsh | any_settings.computable,
    other=st.none() | any_settings.harsh,
    batch=arrivals.map(ascending),
    recorded=st.just([]) | st.lists(st.lists(recorded_decisions, max_size=8), max_size=3),
)
def test_compiled_and_plain_rules_agree(
    own: LinkSettings,
    other: LinkSettings | None,
    batch: Batch,
    recorded: list[list[RecordedDecision]],
) -> None:
    plain, compiled = Link(own, 3, "a", decisions=recorded), Compiled(own, decisions=recorded)
    half = len(batch) if other is None else len(batch) // 2
    if half:
        check_same(compiled, plain, batch[:half])
    if other is not None:
        plain.change(other)
        compiled.change(other)
        check_same(compiled, plain, batch[half:])


def test_many_decisions_of_all_impairments_are_the_same() -> None:
    """Five thousand datagrams, with all impairments together."""
    rng = np.random.default_rng(5)
    limits = (FLOWS, 1500, 2_000_000)
    batch = ascending(list(zip(*(rng.integers(0, n, 5_000).tolist() for n in limits), strict=True)))
    decisions = check_same(Compiled(EVERYTHING), Link(EVERYTHING, 3, "a"), batch)
    fate = list(PacketDecision.__slots__).index("fate")
    assert {decision[fate] for decision in decisions} == set(range(6))


@pytest.mark.parametrize("mansd", [None, 2])
def test_recorded_decisions_are_repeated_by_flow_not_by_row(mansd: int | None) -> None:
    own = LinkSettings(mansd=mansd)
    recorded = [[RecordedDecision(0, 5 * flow, -1, -1, -1)] * 3 for flow in range(FLOWS)]
    compiled = Compiled(own, decisions=recorded)
    decisions = compiled.decide([(flow, 10, 1000) for flow in range(FLOWS)])
    names = list(PacketDecision.__slots__)
    releases = [decision[names.index("release_ns")] for decision in decisions]
    assert releases == [1000 + 5 * flow for flow in range(FLOWS)]


def test_records_and_rows_hold_the_same() -> None:
    rows = array_of(dtype_of(PacketDecision), [PacketDecision(*range(13))])
    assert [rows[0][name] for name in dtype_of(PacketDecision).names or ()] == list(range(13))
