"""The compiled rules and the plain rules make the same decisions, bit for bit."""

from collections.abc import Sequence
from dataclasses import astuple
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from netem.engine.many_decisions import admit_many
from netem.rule_program import empty_state, new_flow, new_memory, program_of, recent_width
from noack.impairments.kinds.blackout import Blackout
from noack.impairments.kinds.corrupt import Corrupt
from noack.impairments.kinds.delay import Delay
from noack.impairments.kinds.duplicate import Duplicate
from noack.impairments.kinds.loss import LossOf
from noack.impairments.kinds.rate import Rate
from noack.impairments.kinds.reorder import Reorder
from noack.impairments.link_records import (
    LinkMemory,
    PacketDecision,
    RecordedDecision,
    array_of,
    dtype_of,
)
from noack.impairments.link_settings import LinkSettings
from noack.impairments.loss_models.gilbert_elliott import GilbertElliottLoss
from tests.netem import any_settings

decisions = st.builds(
    RecordedDecision, fate=st.integers(0, 5), delay_ns=st.integers(-1, 10**7),
    copy_delay_ns=st.just(-1) | st.integers(0, 10**7), bit=st.integers(-1, 9),
    copy_bit=st.integers(-1, 9),
)  # fmt: skip


def plain(
    of: LinkSettings, flows: Any, sizes: Any, arrivals: Any, seed: int,
    recorded: Sequence[Sequence[RecordedDecision]] = (),
) -> tuple[list[PacketDecision], LinkMemory]:  # fmt: skip
    program = program_of(of, seed, "test", decisions=recorded)
    many = max(flows) + 1
    state = empty_state(program)._replace(
        flows=[new_flow(flow, of.first_delivered) for flow in range(many)],
        memory=[new_memory(program) for _ in range(many)],
        recent_ns=[[-1] * recent_width(program) for _ in range(many)],
    )
    verdicts = [PacketDecision() for _ in flows]
    admit_many(program, state, flows, sizes, arrivals, verdicts)
    return verdicts, state


def rows(records: Sequence[Any]) -> Any:
    return np.array([astuple(one) for one in records], dtype_of(type(records[0])))


def assert_equal(decided: Any, verdicts: Any, state: LinkMemory) -> None:
    """Compare the decisions and the link's whole memory."""
    np.testing.assert_array_equal(decided.verdicts, rows(verdicts))
    np.testing.assert_array_equal(decided.state.flows, rows(state.flows))
    np.testing.assert_array_equal(decided.state.recent_ns, state.recent_ns)
    np.testing.assert_array_equal(decided.state.departures_ns, state.departures_ns)
    if state.queues:
        queues = array_of(decided.state.queues.dtype, state.queues)
        np.testing.assert_array_equal(decided.state.queues, queues)
    for compiled_row, memories in zip(decided.state.memory, state.memory, strict=True):
        if memories:
            np.testing.assert_array_equal(compiled_row, rows(memories))
    assert decided.state.counters.tolist() == astuple(state.counters)
    assert decided.state.link.tolist() == astuple(state.link)


@settings(max_examples=100)
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
    decide: Any, of: LinkSettings, steps: Any, seed: int, recorded: Any
) -> None:
    flows, sizes, gaps = (list(column) for column in zip(*steps, strict=True))
    arrivals = np.cumsum(gaps).tolist()
    for again in ((), recorded):
        verdicts, state = plain(of, flows, sizes, arrivals, seed, again)
        decided = decide(
            of, len(flows), seed=seed, flows=flows, sizes_bytes=sizes, arrivals_ns=arrivals,
            decisions=again,
        )  # fmt: skip
        assert_equal(decided, verdicts, state)


EVERYTHING = LinkSettings(
    impairments=(
        LossOf(loss=GilbertElliottLoss(good_to_bad=0.1, bad_to_good=0.2, loss_in_bad=0.9)),
        Duplicate(probability=0.1),
        Corrupt(probability=0.1, correlation=0.5),
        Delay(delay_s=0.005, jitter_s=0.003, distribution="paretonormal", loss_correlation=0.5),
        Reorder(probability=0.1),
        Rate(rate_bps=10_000_000, queue=20),
        Blackout(intervals_s=((0.5, 0.6),), every_s=1.0),
    ),
    mansd=4,
    limit=1_000_000,
)


def test_many_decisions_of_all_impairments_are_the_same(decide: Any) -> None:
    """Twenty thousand datagrams of three flows, with all impairments together."""
    count = 20_000
    rng = np.random.default_rng(5)
    flows = rng.integers(0, 3, count)
    sizes = rng.integers(0, 1500, count)
    arrivals = np.cumsum(rng.integers(0, 2_000_000, count))
    verdicts, state = plain(EVERYTHING, flows.tolist(), sizes.tolist(), arrivals.tolist(), 9)
    decided = decide(
        EVERYTHING, count, seed=9, flows=flows, sizes_bytes=sizes, arrivals_ns=arrivals
    )
    assert_equal(decided, verdicts, state)
    assert (np.bincount(decided.fates, minlength=6) > 0).all()


def test_recorded_decisions_are_replayed_exactly(decide: Any) -> None:
    """At the same times, a replay repeats the recorded decisions; after them, the rules decide."""
    count, recorded = 20_000, 15_000
    rng = np.random.default_rng(6)
    arrivals = np.cumsum(rng.integers(0, 2_000_000, count))
    first = decide(EVERYTHING, count, seed=1, arrivals_ns=arrivals)
    past = first.verdicts[:recorded]
    delays = np.where(past["release_ns"] >= 0, past["release_ns"] - arrivals[:recorded], -1)
    copies = np.where(past["copy_ns"] >= 0, past["copy_ns"] - arrivals[:recorded], -1)
    taken = [
        RecordedDecision(*row)
        for row in zip(
            past["fate"].tolist(), delays.tolist(), copies.tolist(), past["bit"].tolist(),
            past["copy_bit"].tolist(), strict=True,
        )
    ]  # fmt: skip
    again = decide(EVERYTHING, count, seed=2, arrivals_ns=arrivals, decisions=[taken])
    for field in (
        "fate",
        "packet",
        "consecutive_losses",
        "release_ns",
        "copy_ns",
        "bit",
        "copy_bit",
    ):
        np.testing.assert_array_equal(again.verdicts[field][:recorded], past[field])
    assert (again.verdicts["hold_back_ns"][:recorded] == 0).all()
    assert (again.fates[recorded:] != first.fates[recorded:]).any()


@pytest.mark.parametrize("mansd", [0, 2, 9])
def test_a_million_decisions_keep_the_guarantee(
    decide: Any, longest_undelivered: Any, mansd: int
) -> None:
    count = 1_000_000
    rng = np.random.default_rng(mansd)
    arrivals = np.cumsum(rng.integers(0, 1_000_000, count))
    decided = decide(
        EVERYTHING.model_copy(update={"mansd": mansd}), count, seed=mansd, arrivals_ns=arrivals,
        flows=rng.integers(0, 10, count), sizes_bytes=rng.integers(0, 1500, count),
    )  # fmt: skip
    assert longest_undelivered(decided).max() == mansd
