"""Compiled rules and the same rules in Python make the same decisions, bit for bit."""

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
from noack.impairments.link_records import (
    Counters,
    FlowState,
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
arrivals = st.lists(
    st.tuples(st.integers(0, FLOWS - 1), st.integers(0, 2000), st.integers(0, 3_000_000)),
    min_size=1,
    max_size=120,
)


class Compiled:
    """A link with compiled rules; its rows are not in the order of its flows."""

    def __init__(self, own: LinkSettings, **others: Any) -> None:
        self.program: LinkProgram = compiled_program(plain := program_of(own, 3, "a", **others))
        self.state = compiled_state(plain, FLOWS)
        self._first_delivered = own.first_delivered
        self._seen: set[int] = set()

    def decide(self, batch: list[tuple[int, int, int]]) -> list[tuple[Any, ...]]:
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
        program = compiled_program(plain)
        compile_rule(carry)(self.program, self.state, program, state, np.full(FLOWS, -1))
        self.program, self.state = program, state


def row_of(flow: int) -> int:
    return FLOWS - 1 - flow


def ascending(batch: list[tuple[int, int, int]]) -> list[tuple[int, int, int]]:
    times = np.cumsum([gap for _, _, gap in batch]).tolist()
    return [(flow, size, t) for (flow, size, _), t in zip(batch, times, strict=True)]


@settings(max_examples=120)
@given(own=any_settings.harsh, other=st.none() | any_settings.harsh, batch=arrivals)
def test_compiled_and_plain_rules_agree(
    own: LinkSettings, other: LinkSettings | None, batch: list[tuple[int, int, int]]
) -> None:
    plain, compiled = Link(own, 3, "a"), Compiled(own)
    batch = ascending(batch)
    half = len(batch) // 2
    parts = [batch] if other is None or not half else [batch[:half], batch[half:]]
    for number, part in enumerate(parts):
        if number and other is not None:
            plain.change(other)
            compiled.change(other)
        assert compiled.decide(part) == [astuple(plain.decide(*arrival)) for arrival in part]
    assert Counters(*compiled.state.counters.tolist()) == plain.counters  # type: ignore[attr-defined]
    for flow in range(FLOWS):
        expected = plain.flow(flow)
        found = FlowState(*compiled.state.flows[row_of(flow)].tolist())  # type: ignore[attr-defined]
        assert expected is None or found == expected


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
