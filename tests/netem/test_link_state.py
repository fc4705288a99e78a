"""One direction of a link: random streams, limits, counters, and changes of its settings."""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from netem.core.core_library import core
from netem.core.packet_rows import NETEM_PACKET, Fate
from netem.impairments.kinds.opportunities import Opportunities
from netem.impairments.link_settings import LinkSettings
from netem.link_state import LinkState
from netem.tc_words import settings_of
from noack.machines.run_channel import Datagram, channel_of
from noack.protocol.record_tables import tables
from noack.protocol.roles import Notice, Record
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import validate
from tests.netem.stepped_link import Link
from tests.oracles.loss_decisions import fates_of_flow

MS = 1_000_000
LOSSES = [
    "loss 60%", "loss gemodel 30% 20%", "loss 40% 70%", "loss state 30% 20% 30% 50% 20%",
    "loss worst",
]  # fmt: skip
TIMELESS = {
    "loss": "loss 60%",
    "duplicate": "duplicate 30% 50%",
    "corrupt": "corrupt 30%",
    "delay": "delay 10ms 5ms 30% distribution normal",
    "reorder": "reorder 20%",
}
ALL_TIMELESS = " ".join(TIMELESS.values())

Outputs = Sequence[Datagram | Record | Notice]


def new_link(words: str) -> Link:
    return Link(settings_of(words), 5, "a")


def rows_of(outputs: Outputs, table: str = NETEM_PACKET) -> Any:
    rows = [output.row for output in outputs if isinstance(output, Record) and output.table == table]
    return np.array(rows, tables(1, 1)[table])


def sent(outputs: Outputs) -> list[Datagram]:
    return [output for output in outputs if isinstance(output, Datagram)]


def fate_of(link: Link, flow: int, now_ns: int = 0) -> Fate:
    (row,) = rows_of(link.handle(Datagram(flow, b""), now_ns))
    return Fate(row["fate"])


def fates(link: Link, flow: int, count: int) -> list[Fate]:
    return [fate_of(link, flow) for _ in range(count)]


@pytest.mark.parametrize(
    "loss",
    [
        "loss 60%", "loss gemodel 30% 20%", "loss gemodel 40% 30% 90% 10%",
        "duplicate 50% loss 70%", "duplicate 60% loss gemodel 40% 30% 90% 10%",
        "loss 20% duplicate 100% loss 70% duplicate 50% loss 60%",
    ],
)  # fmt: skip
@pytest.mark.parametrize("guarantee", ["", "mansd 2 first", "mansd 4 atmost 3 in 7", "mansd 3 recover 2"])
def test_the_fates_are_those_of_the_definition(loss: str, guarantee: str) -> None:
    settings = settings_of(f"{loss} {guarantee}")
    link = Link(settings, 11, "a")
    for flow in range(3):
        assert fates(link, flow, 200) == fates_of_flow(settings, 11, "a", flow, 200)


def drain(link: Link) -> list[tuple[int, Outputs]]:
    """Release all datagrams in flight, each at its due time."""
    released = []
    while (due := link.next_deadline_ns()) is not None:
        released.append((due, link.on_timer(due)))
    return released


@given(
    st.sampled_from([*LOSSES, ALL_TIMELESS]), st.none() | st.integers(0, 4),
    st.lists(st.tuples(st.integers(0, 3), st.integers(0, 10**12)), max_size=60),
)  # fmt: skip
def test_a_flows_fates_depend_on_nothing_but_its_own_order(
    words: str, mansd: int | None, arrivals: list[tuple[int, int]]
) -> None:
    """Other flows and arrival times change no fate, bit, copy or delay, except with rates,
    blackouts and the limit. Delays are without the time that the guarantee adds."""
    words += "" if mansd is None else f" mansd {mansd}"
    link, outcomes = new_link(words), dict[int, list[tuple[int, ...]]]()

    def decided(by: Link, flow: int, now_ns: int) -> tuple[int, ...]:
        decision = by.decide(flow, 100, now_ns)
        delay_ns = decision.release_ns - decision.hold_back_ns - now_ns if decision.bit < 0 else -1
        return decision.fate, decision.consecutive_losses, decision.bit, decision.copy_bit, max(delay_ns, -1)

    for flow, now_ns in arrivals:
        outcomes.setdefault(flow, []).append(decided(link, flow, now_ns))
    for flow, of_flow in outcomes.items():
        alone = new_link(words)
        assert of_flow == [decided(alone, flow, k * 10**9) for k in range(len(of_flow))]


@pytest.mark.parametrize("words", LOSSES[:-1])
def test_every_seed_name_and_flow_has_a_stream_of_its_own(words: str) -> None:
    """Which no other impairment changes, but for one that makes copies, each with its own fate."""
    sequences = [
        tuple(fates(Link(settings_of(words), seed, *name), flow, 100))
        for seed, name, flow in itertools.product((5, 6), (("a",), ("b",), ("a", "b")), (0, 1))
    ]
    assert len(set(sequences)) == 12
    for more_words in (words, f"delay 10ms 5ms {words}", f"{words} duplicate 50%"):
        assert tuple(fates(new_link(more_words), 0, 100)) == sequences[0]


def test_each_copy_of_a_duplicate_has_a_fate_of_its_own() -> None:
    """In the order of the words: behind a loss there is only one draw for both."""
    before, behind = (
        fates(new_link(words), 0, 4000).count(Fate.DROPPED) / 4000
        for words in ("duplicate 100% loss 50%", "loss 50% duplicate 100%")
    )
    assert abs(before - 0.25) < 0.03
    assert abs(behind - 0.5) < 0.03


@pytest.mark.parametrize(
    ("words", "forwarded"),
    [
        # What passes the impairment later than the blackout's begin is lost.
        ("duplicate 100% delay 10ms samples 0ms,20ms blackout 20ms-1s", None),
        ("duplicate 100% rate 8kbit 0 queue 1", 1),
        ("duplicate 100% loss worst", 0),
        ("duplicate 100% loss worst mansd 0", 1),
        ("duplicate 100% corrupt 100% mansd 0", 2),
        ("duplicate 100% corrupt 100% loss worst mansd 0", 1),
    ],
)
def test_impairments_act_on_each_copy_by_itself(words: str, forwarded: int | None) -> None:
    counts = set()
    for seed in range(40):
        link = Link(settings_of(words), seed, "a", flows=2)
        link.handle(Datagram(0, b"x" * 10), 0)
        drain(link)
        counts.add(link.counters.forwarded)
        if link.state.settings.mansd is not None:
            assert link.counters.forced == 1
            assert link.counters.longest_loss_burst == 0
    assert counts == ({0, 1, 2} if forwarded is None else {forwarded})


def test_the_slot_of_a_copy_is_taken() -> None:
    link = Link(settings_of("duplicate 100% schedule 0 slot 1ms"), 0, "a", flows=1)
    for _ in range(3):
        link.handle(Datagram(0, b"x"), 1)
    assert [t_ns // MS for t_ns, _ in drain(link)] == [1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize(
    ("words", "overflowed"),
    [
        ("delay 10ms", 15),
        ("duplicate 100% delay 10ms", 17),
    ],
)
def test_the_limit_bounds_the_datagrams_and_copies_in_flight(words: str, overflowed: int) -> None:
    link = new_link(f"{words} limit 5")
    assert fates(link, 0, 20).count(Fate.OVERFLOWED) == overflowed
    assert link.counters.most_in_flight == 5
    assert len(drain(link)) == 5
    assert fate_of(link, 0, 20 * MS) is Fate.DELIVERED


@pytest.mark.parametrize(
    ("network", "expected"),
    [
        ({}, "FddFddF"),
        ({"initial_sync": "known_state"}, "ddFddFd"),
        ({"mansd": 0}, "FFFFFFF"),
        ({"enforce_mansd": False, "initial_sync": "known_state"}, "ddddddd"),
        ({"enforce_mansd": False}, "Fdddddd"),
    ],
)
def test_the_link_of_a_scenario_keeps_its_mansd(
    content: dict[str, Any], network: dict[str, Any], expected: str
) -> None:
    content["network"] |= {"loss": {"model": "worst_case"}, **network}
    (link,) = channel_of(resolve(validate(content, "here"))).links
    letters = "".join("dF"[link.decide(0, 72, 0).fate == Fate.FORCED] for _ in range(7))
    assert letters == expected


def test_a_refused_change_leaves_a_link_as_it_was() -> None:
    link = LinkState(settings_of("delay 1ms"), 1, "any")
    link.start_flow(0, 0)
    refused = LinkSettings.model_construct(limit=-1)
    with pytest.raises(ValueError, match="link: a length or limit is negative"):
        link.change(refused, np.full(1, core.NOACK_NEVER_NS))
    assert link.decide(0, 72, 0).release_ns == MS


@pytest.mark.sanitized
def test_a_link_has_room_for_any_number_of_flows() -> None:
    link = LinkState(settings_of("loss 50% mansd 4 atmost 3 in 7 delay 1ms"), 1, "any")
    for row in (0, 1, 2, 3, 100):
        link.start_flow(row, row)
    assert len(link.flows) == link.rows == 101
    assert link.flows["number"][[0, 1, 2, 3, 100]].tolist() == [0, 1, 2, 3, 100]


@pytest.mark.sanitized
def test_packets_that_must_pass_pass_a_queue_that_cannot_be_served_in_time() -> None:
    served = Opportunities(times_ms=(0, 10**12), overhead_bytes=65_535, queue=2)
    link = LinkState(LinkSettings(impairments=(served,), mansd=0), 1, "late")
    link.start_flow(0, 0)
    count = 250_000
    rows, sizes = np.zeros(count, np.int64), np.full(count, 65_535, np.int64)
    decisions = link.decide_many(rows, sizes, np.full(count, 2**61 - 10**9))
    assert (decisions["fate"] <= core.NOACK_FORCED).all()
