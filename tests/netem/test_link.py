import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from netem.link_machine import Datagram, Link, update_link_of
from noack.config.resolution import resolve
from noack.config.scenario_file import validate
from noack.impairments.kinds import AnyImpairment
from noack.impairments.kinds.blackout import Blackout
from noack.impairments.kinds.corrupt import Corrupt
from noack.impairments.kinds.delay import Delay
from noack.impairments.kinds.duplicate import Duplicate
from noack.impairments.kinds.loss import LossOf
from noack.impairments.kinds.rate import Rate
from noack.impairments.kinds.reorder import Reorder
from noack.impairments.link_settings import LinkSettings
from noack.impairments.loss_models import Loss
from noack.impairments.loss_models.bernoulli import BernoulliLoss
from noack.impairments.loss_models.four_state import FourStateLoss
from noack.impairments.loss_models.gilbert_elliott import GilbertElliottLoss
from noack.impairments.loss_models.worst_case import WorstCaseLoss
from noack.protocol.machine_interface import Notice, Record
from noack.protocol.record_tables import (
    NETEM_PACKET,
    NETEM_RELEASE,
    PACKET_HEAD_BYTES,
    Fate,
    tables,
)

MS = 1_000_000
BERNOULLI = BernoulliLoss(probability=0.6)
BURSTS = GilbertElliottLoss(good_to_bad=0.3, bad_to_good=0.2)
CORRELATED = BernoulliLoss(probability=0.4, correlation=0.7)
STATES = FourStateLoss(p13=0.3, p31=0.2, p32=0.3, p23=0.5, p14=0.2)
ALL = WorstCaseLoss()
LOSSES = [BERNOULLI, BURSTS, CORRELATED, STATES, ALL]
JITTER = Delay(delay_s=0.01, jitter_s=0.005, distribution="normal", correlation=0.3)
TIMELESS: tuple[AnyImpairment, ...] = (
    LossOf(loss=BERNOULLI),
    Duplicate(probability=0.3, correlation=0.5),
    Corrupt(probability=0.3),
    JITTER,
    Reorder(probability=0.2),
)

Outputs = Sequence[Datagram | Record | Notice]


def new_link(
    *impairments: AnyImpairment, mansd: int | None = 3, seed: int = 5, **more: Any
) -> Link:
    return Link(
        LinkSettings(impairments=impairments or (LossOf(loss=BERNOULLI),), mansd=mansd, **more),
        seed,
        "a",
    )


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


# Inputs that determine a flow's fates.


@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: loss.model)
@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 10**12)), max_size=60))
def test_a_flows_fates_depend_on_nothing_but_its_own_order(
    loss: Loss, arrivals: list[tuple[int, int]]
) -> None:
    """Fates do not depend on other flows or on arrival times."""
    link = new_link(LossOf(loss=loss))
    found: dict[int, list[Fate]] = {flow: [] for flow in range(4)}
    for flow, now_ns in arrivals:
        found[flow].append(fate_of(link, flow, now_ns))
    for flow, seen in found.items():
        assert seen == fates(new_link(LossOf(loss=loss)), flow, len(seen))


@given(
    st.lists(st.tuples(st.integers(0, 3), st.integers(0, 10**9)), max_size=60),
    st.none() | st.integers(0, 4),
)
def test_nor_do_bits_copies_and_delays(arrivals: list[tuple[int, int]], mansd: int | None) -> None:
    """Other flows do not change bits, copies and delays either, except with rates, blackouts and
    the limit. Delays are measured from the arrival, without the time that the guarantee adds."""
    link = new_link(*TIMELESS, mansd=mansd)
    found: dict[int, list[tuple[int, ...]]] = {flow: [] for flow in range(4)}

    def decision(of: Link, flow: int, now_ns: int) -> tuple[int, ...]:
        verdict = of.decide(flow, 100, now_ns)
        wish = verdict.release_ns - verdict.hold_back_ns - now_ns if verdict.bit < 0 else -1
        return (
            verdict.fate,
            verdict.consecutive_losses,
            verdict.bit,
            verdict.copy_bit,
            max(wish, -1),
        )

    for flow, now_ns in arrivals:
        found[flow].append(decision(link, flow, now_ns))
    for flow, seen in found.items():
        alone = new_link(*TIMELESS, mansd=mansd)
        assert seen == [decision(alone, flow, k * 10**9) for k in range(len(seen))]


@pytest.mark.parametrize("loss", LOSSES[:-1], ids=lambda loss: loss.model)
def test_every_seed_name_and_flow_has_a_stream_of_its_own(loss: Loss) -> None:
    settings = LinkSettings(impairments=(LossOf(loss=loss),))
    sequences = [
        tuple(fates(Link(settings, seed, *name), flow, 200))
        for seed, name, flow in itertools.product((5, 6), (("a",), ("b",), ("a", "b")), (0, 1))
    ]
    assert len(set(sequences)) == 12
    assert tuple(fates(Link(settings, 5, "a"), 0, 200)) == sequences[0]


def test_two_impairments_of_a_kind_are_independent() -> None:
    """Each impairment has loss probability 1/2; together they lose three packets in four."""
    half = LossOf(loss=BernoulliLoss(probability=0.5))
    lost = np.array(fates(new_link(half, half, mansd=None), 0, 4000)) == Fate.DROPPED
    assert abs(lost.mean() - 0.75) < 5 * np.sqrt(0.75 * 0.25 / 4000)


@pytest.mark.parametrize("mansd", [None, 2])
@pytest.mark.parametrize(
    "other",
    [JITTER, Duplicate(probability=0.5), Reorder(), Delay(delay_s=1.0), Corrupt(probability=0.0)],
    ids=lambda one: one.kind,
)
def test_adding_an_impairment_does_not_change_what_is_lost(
    mansd: int | None, other: AnyImpairment
) -> None:
    loss = LossOf(loss=CORRELATED)
    alone = fates(new_link(loss, mansd=mansd), 0, 500)
    assert alone == fates(new_link(other, loss, mansd=mansd), 0, 500)
    assert alone == fates(new_link(loss, other, mansd=mansd), 0, 500)


CHANGES: dict[str, tuple[dict[str, Any], str]] = {
    "loss": ({"loss": BernoulliLoss(probability=0.1)}, "lost"),
    "duplicate": ({"probability": 0.8}, "copied"),
    "corrupt": ({"probability": 0.9}, "bit"),
    "delay": ({"delay_s": 0.02}, "delay_ns"),
    "reorder": ({"probability": 0.9}, "delay_ns"),
}


@pytest.mark.parametrize("place", range(len(TIMELESS)), ids=CHANGES.keys())
def test_another_probability_changes_no_other_randomness(place: int) -> None:
    """The unaffected parts of each decision stay the same, as far as they are observable."""
    one = TIMELESS[place]
    new, its_own = CHANGES[one.kind]
    changed = [*TIMELESS[:place], one.model_copy(update=new), *TIMELESS[place + 1 :]]

    def visible(impairments: Sequence[AnyImpairment]) -> list[dict[str, Any]]:
        link, found = new_link(*impairments, mansd=None), []
        for k in range(2000):
            verdict = link.decide(0, 100, k * 10**9)
            seen: dict[str, Any] = {"lost": verdict.fate == Fate.DROPPED}
            if not seen["lost"]:
                seen["copied"] = verdict.copy_ns >= 0
                if not seen["copied"]:  # with a copy, either can leave first
                    seen |= {"bit": verdict.bit, "delay_ns": verdict.release_ns - k * 10**9}
            found.append(seen)
        return found

    compared = dict.fromkeys(("lost", "copied", "bit", "delay_ns"), 0)
    for before, after in zip(visible(TIMELESS), visible(changed), strict=True):
        for name in before.keys() & after.keys() - {its_own}:
            assert before[name] == after[name]
            compared[name] += 1
    assert all(count > 50 for name, count in compared.items() if name != its_own)


def test_the_payload_does_not_change_the_decision() -> None:
    zeros, full = new_link(*TIMELESS), new_link(*TIMELESS)
    for k in range(200):
        (one,) = rows_of(zeros.handle(Datagram(0, bytes(k)), 0))
        (other,) = rows_of(full.handle(Datagram(0, bytes([k]) * k), 0))
        for name in ("fate", "release_ns", "copy_ns", "bit"):
            assert one[name] == other[name]


def test_the_size_of_a_datagram_does_not_change_its_loss() -> None:
    small, great = new_link(mansd=None), new_link(mansd=None)
    for k in range(200):
        one, other = small.decide(0, 0, 0).fate, great.decide(0, 10 * k, 0).fate
        assert one == other


# The fate of a datagram.


@given(st.lists(st.binary(max_size=100), min_size=1, max_size=20))
def test_what_survives_is_forwarded_untouched_and_everything_is_recorded(data: list[bytes]) -> None:
    link = new_link(mansd=1)
    for k, payload in enumerate(data):
        message = Datagram(7, payload)
        outputs = link.handle(message, 1000 + k)
        (row,) = rows_of(outputs)
        dropped = row["fate"] == Fate.DROPPED
        assert sent(outputs) == ([] if dropped else [message])
        assert (row["input"], row["sequence"], row["flow"]) == (k, k, 7)
        assert (row["t_ns"], row["now_ns"]) == (1000 + k, 1000 + k)
        assert row["release_ns"] == (-1 if dropped else 1000 + k)
        assert (row["copy_ns"], row["bit"], row["size_bytes"]) == (-1, -1, len(payload))
        head = payload[:PACKET_HEAD_BYTES]
        assert row["head"].tobytes() == head + bytes(PACKET_HEAD_BYTES - len(head))
    assert link.next_deadline_ns() is None


def test_packets_are_numbered_by_flow_and_losses_counted_by_flow() -> None:
    link = new_link(LossOf(loss=ALL), mansd=2, first_delivered=True)
    found = [rows_of(link.handle(Datagram(flow, b""), 0))[0] for flow in (0, 0, 1, 0, 1, 1, 0)]
    assert [row["input"] for row in found] == list(range(7))
    assert [row["sequence"] for row in found] == [0, 1, 0, 2, 1, 2, 3]
    assert [row["consecutive_losses"] for row in found] == [0, 1, 0, 2, 1, 2, 0]
    forced = [row["fate"] == Fate.FORCED for row in found]
    assert forced == [True, False, True, False, False, False, True]


def test_a_delayed_datagram_leaves_when_it_is_due_and_is_recorded_again() -> None:
    link = new_link(Delay(delay_s=0.01))
    message = Datagram(3, b"abc")
    (row,) = rows_of(link.handle(message, 5 * MS))
    assert (row["release_ns"], row["fate"]) == (15 * MS, Fate.DELIVERED)
    assert link.next_deadline_ns() == 15 * MS
    outputs = link.on_timer(17 * MS)
    assert sent(outputs) == [message]
    (release,) = rows_of(outputs, NETEM_RELEASE)
    assert release.tolist() == (1, 0, 15 * MS, 17 * MS, 3, 0, 0)
    assert link.next_deadline_ns() is None
    assert link.counters.forwarded == 1


@given(st.lists(st.tuples(st.integers(0, 2), st.sampled_from([0, 1, MS, 7 * MS])), max_size=40))
def test_what_is_under_way_leaves_in_the_order_of_time_and_then_of_arrival(
    steps: list[tuple[int, int]],
) -> None:
    """Each datagram and each copy leaves exactly once, at the decided time."""
    whole_ms = Delay(distribution="empirical", samples_s=(0.001, 0.001, 0.005, 0.005))
    link = new_link(Duplicate(probability=0.5), whole_ms, Reorder(probability=0.3), mansd=3)
    now_ns, expected, found = 0, [], []
    for number, (flow, gap_ns) in enumerate(steps):
        now_ns += gap_ns
        while (due := link.next_deadline_ns()) is not None and due <= now_ns:
            (datagram,) = sent(link.on_timer(now_ns))
            found.append((due, datagram.data))
        data = str(number).encode()
        outputs = link.handle(Datagram(flow, data), now_ns)
        (row,) = rows_of(outputs)
        times_ns = (row["release_ns"], row["copy_ns"])
        expected += [(release_ns, data) for release_ns in times_ns if release_ns >= 0]
        found += [(now_ns, datagram.data) for datagram in sent(outputs)]
    found += [(due, sent(outputs)[0].data) for due, outputs in drain(link)]
    assert found == sorted(
        expected, key=lambda leaving: leaving[0]
    )  # stable: ties in order of arrival
    assert link._state.link.in_flight == 0


def test_an_overdue_datagram_is_not_overtaken_by_one_that_comes_later() -> None:
    link = new_link(Delay(delay_s=0.01), Reorder(gap=2))
    first, second = Datagram(0, b"first"), Datagram(0, b"second")
    assert sent(link.handle(first, 0)) == []
    assert sent(link.handle(second, 11 * MS)) == []  # the first was due at 10 ms
    assert [sent(outputs) for _, outputs in drain(link)] == [[first], [second]]


def test_a_stale_datagram_is_recorded_as_such() -> None:
    link = new_link(Delay(delay_s=0.01), Reorder(gap=2))
    link.handle(Datagram(0, b"first"), 0)
    assert sent(link.handle(Datagram(0, b"second"), MS)) == [Datagram(0, b"second")]
    ((due, outputs),) = drain(link)
    (row,) = rows_of(outputs, NETEM_RELEASE)
    assert (due, row["stale"]) == (10 * MS, 1)
    assert (link.counters.delivered_out_of_order, link.counters.longest_loss_burst) == (1, 1)


def test_a_copy_leaves_and_is_recorded_as_a_copy() -> None:
    link = new_link(Duplicate(probability=1.0), Delay(delay_s=0.01))
    (row,) = rows_of(link.handle(Datagram(0, b"x"), 0))
    assert (row["release_ns"], row["copy_ns"]) == (10 * MS, 10 * MS)
    leaving = [rows_of(outputs, NETEM_RELEASE)[0] for _, outputs in drain(link)]
    assert [row["copy"] for row in leaving] == [0, 1]
    assert [row["stale"] for row in leaving] == [0, 0]
    assert link.counters.duplicated == 1
    at_once = new_link(Duplicate(probability=1.0)).handle(Datagram(0, b"x"), 0)
    assert sent(at_once) == [Datagram(0, b"x")] * 2


@given(st.binary(min_size=1, max_size=50))
def test_a_corrupted_datagram_has_one_bit_flipped_and_the_record_says_which(data: bytes) -> None:
    link = new_link(Corrupt(probability=1.0), mansd=None)
    outputs = link.handle(Datagram(0, data), 0)
    (row,), (changed,) = rows_of(outputs), sent(outputs)
    assert row["fate"] == Fate.CORRUPTED
    difference = int.from_bytes(changed.data, "little") ^ int.from_bytes(data, "little")
    assert difference == 1 << int(row["bit"])
    assert row["head"].tobytes()[: len(data)] == data[:PACKET_HEAD_BYTES]  # as received


@pytest.mark.parametrize("copies", [False, True])
def test_the_limit_bounds_the_datagrams_in_flight(copies: bool) -> None:
    impairments = (Duplicate(probability=1.0),) if copies else ()
    link = new_link(*impairments, Delay(delay_s=0.01), mansd=None, limit=5)
    found = fates(link, 0, 20)
    assert found.count(Fate.OVERFLOWED) == (17 if copies else 15)
    assert link.counters.most_in_flight == 5
    assert len(drain(link)) == 5
    assert fate_of(link, 0, 20 * MS) is Fate.DELIVERED


def test_the_limit_also_bounds_copies_of_undelayed_datagrams() -> None:
    link = new_link(Duplicate(probability=1.0), Delay(delay_s=0.01), Reorder(), limit=5)
    for k in range(20):
        link.handle(Datagram(0, b"x"), k)
    assert link.counters.delivered == 20
    assert link.counters.most_in_flight == 5


@given(st.lists(st.integers(0, 2), max_size=60), st.none() | st.integers(0, 3))
def test_every_datagram_is_counted_once(order: list[int], mansd: int | None) -> None:
    link = new_link(
        *TIMELESS, Rate(rate_bps=10**6, queue=3), Blackout(intervals_s=((0.01, 0.03),)),
        mansd=mansd,
    )  # fmt: skip
    found = [fate_of(link, flow, k * MS) for k, flow in enumerate(order)]
    drain(link)
    of = link.counters
    counted = (
        of.delivered, of.dropped, of.forced, of.corrupted, of.overflowed, of.blacked_out,
    )  # fmt: skip
    assert list(counted) == [found.count(fate) for fate in Fate]
    assert of.received == len(order)
    assert of.forwarded == of.delivered + of.forced + of.corrupted + of.duplicated


# The link of a scenario.


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


def test_losses_depend_on_the_scenarios_loss_seed_only(content: dict[str, Any]) -> None:
    def found(**seeds: int) -> list[Fate]:
        content["seeds"] = seeds
        return fates(update_link_of(resolve(validate(content, "here"))), 0, 100)

    assert found(loss=1) == found(loss=1, plant=9, initial_state=9)
    assert found(loss=1) != found(loss=2)
