"""One direction of a link; and the network of a run, against the plain one in Python."""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from netem import link_state
from netem.channel import Channel, channel_of
from netem.link_state import LinkState
from netem.tc_words import settings_of
from noack.core.core_library import address_of, core, ffi
from noack.impairments.kinds.opportunities import Opportunities
from noack.impairments.link_settings import LinkSettings
from noack.protocol.record_tables import NETEM_PACKET, PACKET_HEAD_BYTES, Fate, tables
from noack.protocol.roles import Notice, Record
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import validate
from tests.netem.any_settings import capped, computable, harsh
from tests.netem.stepped_channel import SteppedChannel
from tests.oracles.link import Datagram, Duplex, Link, update_link_of

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
    found = [one.row for one in outputs if isinstance(one, Record) and one.table == table]
    return np.array(found, tables(1, 1)[table])


def sent(outputs: Outputs) -> list[Datagram]:
    return [one for one in outputs if isinstance(one, Datagram)]


def fate_of(link: Link, flow: int, now_ns: int = 0) -> Fate:
    (row,) = rows_of(link.handle(Datagram(flow, b""), now_ns))
    return Fate(row["fate"])


def fates(link: Link, flow: int, count: int) -> list[Fate]:
    return [fate_of(link, flow) for _ in range(count)]


def drain(link: Link) -> list[tuple[int, Outputs]]:
    """Release all datagrams in flight, each at its due time."""
    found = []
    while (due := link.next_deadline_ns()) is not None:
        found.append((due, link.on_timer(due)))
    return found


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
    link, found = new_link(words), dict[int, list[tuple[int, ...]]]()

    def decided(by: Link, flow: int, now_ns: int) -> tuple[int, ...]:
        one = by.decide(flow, 100, now_ns)
        delay_ns = one.release_ns - one.hold_back_ns - now_ns if one.bit < 0 else -1
        return one.fate, one.consecutive_losses, one.bit, one.copy_bit, max(delay_ns, -1)

    for flow, now_ns in arrivals:
        found.setdefault(flow, []).append(decided(link, flow, now_ns))
    for flow, of_flow in found.items():
        alone = new_link(words)
        assert of_flow == [decided(alone, flow, k * 10**9) for k in range(len(of_flow))]


@pytest.mark.parametrize("words", LOSSES[:-1])
def test_every_seed_name_and_flow_has_a_stream_of_its_own(words: str) -> None:
    """Which no other impairment changes."""
    sequences = [
        tuple(fates(Link(settings_of(words), seed, *name), flow, 100))
        for seed, name, flow in itertools.product((5, 6), (("a",), ("b",), ("a", "b")), (0, 1))
    ]
    assert len(set(sequences)) == 12
    for one in (words, f"delay 10ms 5ms {words}", f"{words} duplicate 50%"):
        assert tuple(fates(new_link(one), 0, 100)) == sequences[0]


@pytest.mark.parametrize(
    ("words", "overflowed"),
    [
        ("delay 10ms", 15),
        ("duplicate 100% delay 10ms", 17),
        ("duplicate 100% delay 10ms reorder 100% mansd 3", 0),  # only copies are delayed
    ],
)
def test_the_limit_bounds_the_datagrams_and_copies_in_flight(words: str, overflowed: int) -> None:
    link = new_link(f"{words} limit 5")
    assert fates(link, 0, 20).count(Fate.OVERFLOWED) == overflowed
    assert link.counters.most_in_flight == 5
    assert len(drain(link)) == 5
    assert fate_of(link, 0, 20 * MS) is Fate.DELIVERED


@given(st.lists(st.integers(0, 2), max_size=60), st.none() | st.integers(0, 3))
def test_every_datagram_is_counted_once(order: list[int], mansd: int | None) -> None:
    cap = "" if mansd is None else f"mansd {mansd}"
    link = new_link(f"{ALL_TIMELESS} rate 1mbit queue 3 blackout 10ms-30ms {cap}")
    found = [fate_of(link, flow, k * MS) for k, flow in enumerate(order)]
    drain(link)
    of = link.counters
    counted = (
        of.delivered, of.dropped, of.forced, of.corrupted, of.overflowed, of.blacked_out,
    )  # fmt: skip
    assert list(counted) == [found.count(fate) for fate in Fate]
    assert of.received == len(order)
    assert of.forwarded == of.delivered + of.forced + of.corrupted + of.duplicated


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
    link = update_link_of(resolve(validate(content, "here")))
    found = "".join("dF"[fate is Fate.FORCED] for fate in fates(link, 0, 7))
    assert found == expected


def test_a_refused_change_leaves_a_link_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    link = LinkState(settings_of("delay 1ms"), 1, "any")
    link.start_flow(0, 0)
    begin = address_of(link.core.memory), address_of(link.core.stages)

    def refuse(wrong: object) -> None:
        raise ValueError("link: refused")

    monkeypatch.setattr(link_state, "_require", refuse)
    with pytest.raises(ValueError, match="refused"):
        link.change(LinkSettings(), np.full(1, core.NOACK_NEVER_NS))
    assert (link._memory["memory"].ctypes.data, address_of(link._stages)) == begin
    assert link.decide(0, 72, 0).release_ns == MS


LOOPS = 4
any_link = st.one_of(computable, harsh, capped)
arrivals = st.lists(
    st.tuples(
        st.integers(0, 2 * LOOPS - 1), st.sampled_from([0, 1, 20, 32, 72, 1500]),
        st.one_of(st.integers(0, 10**7), st.integers(0, 10**10)), st.booleans(),
    ),
    max_size=60,
)  # fmt: skip
"""Flow, size, time since the datagram before, and whether what is due has left."""


def content_of(outputs: Sequence[Any]) -> tuple[list[tuple[int, bytes]], list[Any]]:
    datagrams = [(one.flow, one.data) for one in outputs if not isinstance(one, Record)]
    rows = [(one.table, *map(plain, one.row)) for one in outputs if isinstance(one, Record)]
    return datagrams, rows


def plain(value: Any) -> bytes | int:
    return bytes(value) if isinstance(value, bytes | np.void) else int(value)


@given(any_link, any_link, st.none() | any_link, arrivals, st.sampled_from([0, 2**40]))
def test_it_does_what_the_plain_network_does(
    first: LinkSettings,
    second: LinkSettings,
    later: LinkSettings | None,
    arriving: Sequence[tuple[int, int, int, bool]],
    number: int,
) -> None:
    named = (first, 5, "update"), (second, 5, "actuation")
    forward, reverse = (Link(*one, first_number=number, loops=LOOPS) for one in named)
    expected = Duplex(forward, reverse, first_number=number, loops=LOOPS)
    links = [LinkState(*one, rows=LOOPS) for one in named]
    channel = SteppedChannel(Channel(links, loops=LOOPS, first_number=number))
    now_ns, rng = 0, np.random.default_rng(1)
    for k, (flow, size, step_ns, leaves) in enumerate(arriving):
        if later is not None and k == len(arriving) // 2:
            changed = later.model_copy(update={"first_delivered": first.first_delivered})
            forward.change(changed)
            channel.channel.change(changed)
        now_ns += step_ns
        while leaves and (due_ns := expected.next_deadline_ns()) is not None and due_ns <= now_ns:
            assert channel.next_deadline_ns() == due_ns
            assert content_of(channel.on_timer(now_ns)) == content_of(expected.on_timer(now_ns))
        data = rng.bytes(size)
        if k % 2 and size >= PACKET_HEAD_BYTES:  # an update with an error level
            data = b"NA\1\2\2" + data[5:]
        datagram = Datagram(flow, data)
        assert content_of(channel.handle(datagram, now_ns)) == content_of(expected.handle(datagram, now_ns))
    while (due_ns := expected.next_deadline_ns()) is not None:
        assert channel.next_deadline_ns() == due_ns
        assert content_of(channel.on_timer(due_ns)) == content_of(expected.on_timer(due_ns))
    assert channel.next_deadline_ns() is None
    assert [one.counters for one in channel.channel.links] == [forward.counters, reverse.counters]


def test_room_for_delayed_datagrams_grows(content: dict[str, Any]) -> None:
    delay = {"kind": "delay", "delay_s": 1.0}
    network = content["network"] | {"loss": {"model": "lossless"}, "impairments": [delay]}
    channel = SteppedChannel(channel_of(resolve(validate(content | {"network": network}, ""))))
    sent = [bytes([k % 256, k // 256]) for k in range(1000)]
    for k, data in enumerate(sent):
        assert not content_of(channel.handle(Datagram(0, data), k))[0]
    left = [content_of(channel.on_timer(10**9 + k))[0] for k in range(1000)]
    assert left == [[(0, data)] for data in sent]


def test_numbers_of_no_network_are_refused(content: dict[str, Any]) -> None:
    channel = channel_of(resolve(validate(content, "")))
    own = channel.core
    for name, value in (
        ("loops", 0), ("loops", 2), ("directions", 3), ("places", 1), ("row_places", 0),
        ("heap_count", -1), ("packet_count", own.row_places + 1),
    ):  # fmt: skip
        before = getattr(own, name)
        setattr(own, name, value)
        assert core.noack_channel_check(own) != ffi.NULL
        setattr(own, name, before)
        assert core.noack_channel_check(own) == ffi.NULL


def test_a_queue_that_cannot_be_served_in_time() -> None:
    served = Opportunities(times_ms=(0, 10**12), overhead_bytes=65_535, queue=2)
    link = LinkState(LinkSettings(impairments=(served,), mansd=0), 1, "late")
    link.start_flow(0, 0)
    count = 250_000
    rows, sizes = np.zeros(count, np.int64), np.full(count, 65_535, np.int64)
    decisions = link.decide_many(rows, sizes, np.full(count, 2**61 - 10**9))
    assert (decisions["fate"] <= core.NOACK_FORCED).all()
