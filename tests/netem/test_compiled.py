"""The compiled rules and the plain rules make the same decisions, bit for bit."""

from collections.abc import Sequence
from dataclasses import astuple
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from netem.engine.many_decisions import admit_many
from netem.rule_program import FlowRow, empty_state, new_flow, new_row, program_of
from netem.words.words_to_settings import settings_of
from noack.impairments.link_records import (
    LinkMemory,
    PacketDecision,
    RecordedDecision,
    array_of,
    dtype_of,
)
from noack.impairments.link_settings import LinkSettings
from tests.netem import any_settings

decisions = st.builds(
    RecordedDecision, fate=st.integers(0, 5), delay_ns=st.integers(-1, 10**7),
    copy_delay_ns=st.just(-1) | st.integers(0, 10**7), bit=st.integers(-1, 9),
    copy_bit=st.integers(-1, 9),
)  # fmt: skip


def plain(
    link: LinkSettings, flows: Any, sizes: Any, arrivals: Any, seed: int,
    recorded: Sequence[Sequence[RecordedDecision]] = (),
) -> tuple[list[PacketDecision], LinkMemory]:  # fmt: skip
    program = program_of(link, seed, "test", decisions=recorded)
    many = max(flows) + 1
    flow_rows = [new_row(program, new_flow(flow, link.first_delivered)) for flow in range(many)]
    tables = zip(FlowRow._fields, map(list, zip(*flow_rows, strict=True)), strict=True)
    state = empty_state(program)._replace(**dict(tables))
    expected = [PacketDecision() for _ in flows]
    admit_many(program, state, flows, sizes, arrivals, expected)
    return expected, state


def rows(records: Sequence[Any]) -> Any:
    return np.array([astuple(one) for one in records], dtype_of(type(records[0])))


def assert_equal(decided: Any, expected: Any, state: LinkMemory) -> None:
    """Compare the decisions and the link's whole memory."""
    np.testing.assert_array_equal(decided.decisions, rows(expected))
    np.testing.assert_array_equal(decided.state.flows, rows(state.flows))
    np.testing.assert_array_equal(decided.state.recent_ns, state.recent_ns)
    np.testing.assert_array_equal(decided.state.losses, state.losses)
    np.testing.assert_array_equal(decided.state.departures_ns, state.departures_ns)
    if state.queues:
        queues = array_of(decided.state.queues.dtype, state.queues)
        np.testing.assert_array_equal(decided.state.queues, queues)
    for compiled_row, memories in zip(decided.state.memory, state.memory, strict=True):
        if memories:
            np.testing.assert_array_equal(compiled_row, rows(memories))
    assert decided.state.counters.tolist() == astuple(state.counters)
    assert decided.state.link.tolist() == astuple(state.link)


@settings(max_examples=60)
@given(
    any_settings.computable,
    st.lists(
        st.tuples(st.integers(0, 2), st.integers(0, 1500), st.integers(0, 10**7)),
        min_size=1, max_size=40,
    ),
    st.integers(0, 2**64 - 1),
    st.lists(st.lists(decisions, max_size=8), max_size=3),
)  # fmt: skip
def test_any_link_decides_the_same(
    decide: Any, link: LinkSettings, steps: Any, seed: int, recorded: Any
) -> None:
    flows, sizes, gaps = (list(column) for column in zip(*steps, strict=True))
    arrivals = np.cumsum(gaps).tolist()
    for again in ((), recorded):
        expected, state = plain(link, flows, sizes, arrivals, seed, again)
        decided = decide(
            link, len(flows), seed=seed, flows=flows, sizes_bytes=sizes, arrivals_ns=arrivals,
            recorded=again,
        )  # fmt: skip
        assert_equal(decided, expected, state)


EVERYTHING = settings_of(
    "loss gemodel 10% 20% 90% duplicate 10% corrupt 10% 50% delay 5ms 3ms distribution "
    "paretonormal lossrel 50% reorder 10% rate 10mbit queue 20 blackout 0.5s-0.6s every 1s "
    "mansd 4 limit 1000000"
)


def test_many_decisions_of_all_impairments_are_the_same(decide: Any) -> None:
    """Five thousand datagrams of three flows, with all impairments together."""
    count = 5_000
    rng = np.random.default_rng(5)
    flows = rng.integers(0, 3, count)
    sizes = rng.integers(0, 1500, count)
    arrivals = np.cumsum(rng.integers(0, 2_000_000, count))
    expected, state = plain(EVERYTHING, flows.tolist(), sizes.tolist(), arrivals.tolist(), 9)
    decided = decide(
        EVERYTHING, count, seed=9, flows=flows, sizes_bytes=sizes, arrivals_ns=arrivals
    )
    assert_equal(decided, expected, state)
    assert (np.bincount(decided.fates, minlength=6) > 0).all()
