"""The guarantee, checked by an observer at the receiver without access to the link's decisions.

A datagram carries its number three times, so the observer detects a flipped bit. A datagram counts
as delivered if it is intact and newer than all intact datagrams before it.
"""

import itertools
import struct
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from netem.link_machine import Datagram, Link
from netem.rule_program import empty_state, new_flow, new_memory, program_of, recent_width
from netem.rules import mansd as rule
from netem.rules.link_rules import settle
from noack.impairments.kinds import AnyImpairment
from noack.impairments.kinds.blackout import Blackout
from noack.impairments.kinds.corrupt import Corrupt
from noack.impairments.kinds.delay import Delay
from noack.impairments.kinds.duplicate import Duplicate
from noack.impairments.kinds.loss import LossOf
from noack.impairments.kinds.rate import Rate
from noack.impairments.kinds.reorder import Reorder
from noack.impairments.link_records import (
    DELIVERED,
    DROPPED,
    FlowState,
    PacketDecision,
    RecordedDecision,
)
from noack.impairments.link_settings import LinkSettings
from noack.impairments.loss_models.bernoulli import BernoulliLoss
from noack.impairments.loss_models.four_state import FourStateLoss
from noack.impairments.loss_models.gilbert_elliott import GilbertElliottLoss
from noack.impairments.loss_models.lossless import NoLoss
from noack.impairments.loss_models.periodic_loss import PeriodicLoss
from noack.impairments.loss_models.scripted import ScriptedLoss
from noack.impairments.loss_models.worst_case import WorstCaseLoss

MS = 1_000_000

probabilities = st.sampled_from([0.0, 0.1, 0.5, 0.9, 1.0])
correlations = st.sampled_from([0.0, 0.8])
losses = st.one_of(
    st.just(NoLoss()),
    st.just(WorstCaseLoss()),
    st.builds(BernoulliLoss, probability=probabilities, correlation=correlations),
    st.builds(GilbertElliottLoss, good_to_bad=probabilities, bad_to_good=probabilities),
    st.just(FourStateLoss(p13=0.3, p31=0.2, p32=0.3, p23=0.5, p14=0.2)),
    st.builds(PeriodicLoss, period=st.just(7), burst=st.integers(0, 7), first=st.integers(0, 5)),
    st.sets(st.integers(0, 30)).map(lambda names: ScriptedLoss(lost=tuple(sorted(names)))),
)
delays = st.one_of(
    st.builds(
        Delay,
        delay_s=st.sampled_from([0.0, 0.001, 0.005]),
        jitter_s=st.sampled_from([0.0, 0.001, 0.02]),
        distribution=st.sampled_from(["uniform", "normal", "pareto", "paretonormal"]),
        correlation=correlations,
    ),
    st.just(Delay(distribution="empirical", samples_s=(0.0, 0.001, 0.03))),
)
impairments: st.SearchStrategy[AnyImpairment] = st.one_of(
    losses.map(lambda loss: LossOf(loss=loss)),
    st.builds(Duplicate, probability=probabilities, correlation=correlations),
    st.builds(Corrupt, probability=probabilities, correlation=correlations),
    delays,
    delays,
    st.builds(Reorder, probability=probabilities, gap=st.integers(1, 4)),
    st.builds(Rate, rate_bps=st.sampled_from([100_000, 10**7]), queue=st.integers(1, 5)),
    st.just(Blackout(intervals_s=((0.001, 0.003), (0.004, 0.01)), every_s=0.012)),
)
OVERTAKING: tuple[AnyImpairment, ...] = (
    Delay(delay_s=0.005, jitter_s=0.02),
    Reorder(probability=0.5),
)
links = st.builds(
    LinkSettings,
    impairments=st.tuples(
        st.lists(impairments, max_size=6).map(tuple), st.sampled_from([(), OVERTAKING])
    ).map(lambda both: both[0] + both[1]),
    mansd=st.integers(0, 6),
    first_delivered=st.booleans(),
    limit=st.sampled_from([1, 3, 10_000]),
)
gaps_ns = st.sampled_from([0, 0, 1, 1000, MS // 3, MS, 5 * MS, 100 * MS])


def steps_of(seed: int, count: int) -> list[tuple[int, int]]:
    """Flows and gaps, from a seed: most lists that Hypothesis draws itself are short."""
    rng = np.random.default_rng(seed)
    gaps = rng.choice([0, 1, 1000, MS // 3, MS, 5 * MS, 100 * MS], count)
    return list(zip(rng.integers(0, 3, count).tolist(), gaps.tolist(), strict=True))


arrivals = st.builds(steps_of, st.integers(0, 2**32), st.integers(1, 80))


def payload(flow: int, number: int) -> bytes:
    return struct.pack("<HI", flow, number) * 3


class Observer:
    """Records the numbers of the delivered datagrams of each flow."""

    def __init__(self) -> None:
        self.counted: dict[int, list[int]] = {}

    def see(self, outputs: Sequence[Any]) -> None:
        for one in outputs:
            if not isinstance(one, Datagram):
                continue
            parts = {one.data[k : k + 6] for k in (0, 6, 12)}
            if len(parts) > 1:
                continue
            flow, number = struct.unpack("<HI", parts.pop())
            assert flow == one.flow
            counted = self.counted.setdefault(flow, [])
            if not counted or number > counted[-1]:
                counted.append(number)

    def longest_loss_burst(self, flow: int, sent: int, since: int = 0) -> int:
        """Return the longest loss burst of a flow from number ``since`` on, lost ends included."""
        counted = [number for number in self.counted.get(flow, ()) if number >= since]
        borders = [since - 1, *counted, sent]
        return max(b - a - 1 for a, b in itertools.pairwise(borders))


def send_all(
    link: Link,
    steps: Sequence[tuple[int, int]],
    late: Callable[[], bool] = lambda: False,
    before_each: Callable[[], None] = lambda: None,
) -> tuple[Observer, dict[int, int]]:
    """Send datagrams at their times; before each, serve the due timers unless ``late()``."""
    observer, sent = Observer(), dict[int, int]()
    now_ns = 0
    for flow, gap_ns in steps:
        now_ns += gap_ns
        while (due := link.next_deadline_ns()) is not None and due <= now_ns and not late():
            observer.see(link.on_timer(now_ns))
        before_each()
        number = sent.get(flow, 0)
        sent[flow] = number + 1
        observer.see(link.handle(Datagram(flow, payload(flow, number)), now_ns))
    while (due := link.next_deadline_ns()) is not None:
        now_ns = max(now_ns, due)
        observer.see(link.on_timer(now_ns))
    return observer, sent


def assert_kept(settings: LinkSettings, link: Link, observer: Observer, sent: Any) -> None:
    assert settings.mansd is not None
    assert max(observer.longest_loss_burst(*of_flow) for of_flow in sent.items()) <= settings.mansd
    in_force = 0
    for flow, count in sent.items():
        of_flow = link.flow(flow)
        assert of_flow is not None
        assert of_flow.longest_loss_burst == observer.longest_loss_burst(flow, count, of_flow.since)
        in_force = max(in_force, of_flow.longest_loss_burst)
        if settings.first_delivered:
            assert observer.counted[flow][0] == 0
    assert link.counters.longest_loss_burst == in_force


@settings(max_examples=150)
@given(links, arrivals, st.integers(0, 100))
def test_never_more_than_mansd_in_a_row_are_not_delivered(
    settings: LinkSettings, steps: list[tuple[int, int]], seed: int
) -> None:
    link = Link(settings, seed, "a")
    observer, sent = send_all(link, steps)
    assert_kept(settings, link, observer, sent)


@settings(max_examples=150)
@given(links, arrivals, st.integers(0, 2**32), st.sampled_from([0.1, 0.5, 0.9]))
def test_nor_when_the_shell_is_late(
    settings: LinkSettings, steps: list[tuple[int, int]], seed: int, share: float
) -> None:
    """The guarantee holds if datagrams arrive before overdue timers are served."""
    link = Link(settings, 1, "a")
    rng = np.random.default_rng(seed)
    observer, sent = send_all(link, steps, lambda: rng.random() < share)
    assert_kept(settings, link, observer, sent)


@settings(max_examples=100)
@given(links, st.integers(0, 2**32), st.integers(1, 80))
def test_nor_when_its_clock_goes_astray(settings: LinkSettings, seed: int, count: int) -> None:
    """The guarantee needs no clock: arrival times in any order, timers served too early."""
    link = Link(settings, 1, "a")
    rng = np.random.default_rng(seed)
    observer, sent = Observer(), [0, 0]
    for flow, now_ns in zip(
        rng.integers(0, 2, count).tolist(), rng.integers(0, 10 * MS, count).tolist(), strict=True
    ):
        observer.see(link.handle(Datagram(flow, payload(flow, sent[flow])), now_ns))
        sent[flow] += 1
        if link.next_deadline_ns() is not None and rng.random() < 0.5:
            observer.see(link.on_timer(0))
    while link.next_deadline_ns() is not None:
        observer.see(link.on_timer(0))
    for flow, of_flow in enumerate(sent):
        assert observer.longest_loss_burst(flow, of_flow) <= (settings.mansd or 0)


@settings(max_examples=100)
@given(st.lists(links, min_size=2, max_size=4), arrivals, st.integers(0, 2**32))
def test_nor_when_the_impairments_change(
    stages: list[LinkSettings], steps: list[tuple[int, int]], seed: int
) -> None:
    """The guarantee holds across changes of the impairments that keep the cap."""
    first, rng = stages[0], np.random.default_rng(seed)
    same = {"mansd": first.mansd, "first_delivered": first.first_delivered}
    link = Link(first, 1, "a")

    def change() -> None:
        if rng.random() < 0.2:
            link.change(stages[int(rng.integers(len(stages)))].model_copy(update=same))

    observer, sent = send_all(link, steps, lambda: rng.random() < 0.3, change)
    assert_kept(first, link, observer, sent)


@settings(max_examples=100)
@given(st.lists(links, min_size=2, max_size=4), arrivals, st.integers(0, 2**32))
def test_another_cap_holds_from_when_it_is_in_force(
    stages: list[LinkSettings], steps: list[tuple[int, int]], seed: int
) -> None:
    """It holds for all later arrivals, whatever is in flight or was lost before."""
    rng = np.random.default_rng(seed)
    link = Link(stages[0], 1, "a")
    in_force = [stages[0]]

    def change() -> None:
        if rng.random() < 0.1:
            assert link.counters.longest_loss_burst <= (in_force[-1].mansd or 0)
            in_force.append(stages[int(rng.integers(len(stages)))])
            link.change(in_force[-1])

    observer, sent = send_all(link, steps, lambda: rng.random() < 0.3, change)
    cap = in_force[-1].mansd
    assert cap is not None
    for flow, count in sent.items():
        of_flow = link.flow(flow)
        assert of_flow is not None
        assert (
            of_flow.longest_loss_burst
            == observer.longest_loss_burst(flow, count, of_flow.since)
            <= cap
        )
    assert link.counters.longest_loss_burst <= cap


decisions = st.builds(
    RecordedDecision,
    fate=st.integers(0, 5),
    delay_ns=st.sampled_from([-1, 0, 1, MS, 5 * MS]),
    copy_delay_ns=st.sampled_from([-1, -1, 5 * MS]),
    bit=st.sampled_from([-1, -1, 3]),
    copy_bit=st.sampled_from([-1, 5]),
)


@given(
    st.lists(decisions, max_size=40), st.lists(gaps_ns, min_size=1, max_size=60), st.integers(0, 4),
    st.booleans(),
)  # fmt: skip
def test_nor_when_anything_is_repeated(
    recorded: list[RecordedDecision], gaps: list[int], mansd: int, first: bool
) -> None:
    """The guarantee holds in any replay, also of decisions that no link makes, at other times."""
    settings = LinkSettings(
        impairments=(LossOf(loss=WorstCaseLoss()),), mansd=mansd, first_delivered=first
    )
    link = Link(settings, 1, "a")
    link._program = program_of(settings, 1, "a", decisions=[recorded])
    observer, sent = send_all(link, [(0, gap) for gap in gaps])
    assert_kept(settings, link, observer, sent)


@settings(max_examples=100)
@given(links, arrivals)
def test_without_a_cap_the_first_is_still_delivered(
    settings: LinkSettings, steps: list[tuple[int, int]]
) -> None:
    freely = settings.model_copy(update={"mansd": None, "first_delivered": True})
    observer, sent = send_all(Link(freely, 1, "a"), steps)
    for flow in sent:
        assert observer.counted[flow][0] == 0


# The cap forces and holds back no more datagrams than necessary.


@pytest.mark.parametrize("mansd", range(6))
@pytest.mark.parametrize("first", [False, True])
def test_the_cap_forces_only_the_necessary_packets(decide: Any, mansd: int, first: bool) -> None:
    for impairment in (
        LossOf(loss=WorstCaseLoss()),
        Corrupt(probability=1.0),
        Blackout(intervals_s=((0.0, 1e9),)),
    ):
        settings = LinkSettings(impairments=(impairment,), mansd=mansd, first_delivered=first)
        passed = np.flatnonzero(decide(settings, 1000).fates == 2)
        assert passed.tolist() == list(range(0 if first else mansd, 1000, mansd + 1))


def longest_run_of(releases: Sequence[int | None]) -> int:
    """Return the longest loss burst for the given release times, by brute force."""
    fresh = [
        time is not None
        and not any(later is not None and later < time for later in releases[number + 1 :])
        for number, time in enumerate(releases)
    ]
    borders = [-1, *(number for number, is_fresh in enumerate(fresh) if is_fresh), len(fresh)]
    return max(b - a - 1 for a, b in itertools.pairwise(borders))


@settings(max_examples=120)
@given(st.lists(st.none() | st.integers(0, 12), max_size=24), st.integers(0, 4))
def test_a_datagram_is_held_back_exactly_as_long_as_need_be(
    wishes: list[int | None], mansd: int
) -> None:
    """Compare all times: the earliest at or after the wish that keeps the guarantee is chosen."""
    settings = LinkSettings(impairments=(Delay(delay_s=1.0),), mansd=mansd)
    program = program_of(settings, 0, "a")
    flow, width = new_flow(0, False), recent_width(program)
    state = empty_state(program)._replace(
        flows=[flow], memory=[new_memory(program)], recent_ns=[[-1] * width]
    )
    releases: list[int | None] = []
    for packet, wish in enumerate(wishes):
        if wish is None and rule.must_pass(flow, mansd):
            wish = 0
        if wish is None:
            settle(program, state, 0, PacketDecision(DROPPED, packet))
            releases.append(None)
        else:
            verdict = PacketDecision(DELIVERED, packet, release_ns=wish)
            settle(program, state, 0, verdict)
            alternatives = sorted({wish, *(t for t in releases if t is not None and t > wish)})
            least = next(t for t in alternatives if longest_run_of([*releases, t]) <= mansd)
            assert verdict.release_ns == least
            assert verdict.hold_back_ns == least - wish
            releases.append(least)
        assert longest_run_of(releases) <= mansd


@given(st.lists(st.integers(0, 3), max_size=60), st.integers(0, 4), links)
def test_flows_never_share_a_counter(order: list[int], mansd: int, settings: LinkSettings) -> None:
    """Without shared impairments, each flow has the same consecutive losses as alone."""
    own = tuple(one for one in settings.impairments if not isinstance(one, Rate))
    settings = settings.model_copy(update={"impairments": own, "limit": 10_000, "mansd": mansd})
    together = Link(settings, 3, "a")
    found: dict[int, list[tuple[int, int, int]]] = {}
    for now, flow in enumerate(order):
        verdict = together.decide(flow, 18, now * MS)
        found.setdefault(flow, []).append((now, verdict.fate, verdict.consecutive_losses))
    for flow, of_flow in found.items():
        alone = Link(settings, 3, "a")
        for now, fate, run in of_flow:
            verdict = alone.decide(flow, 18, now * MS)
            assert (verdict.fate, verdict.consecutive_losses) == (fate, run)


def test_a_duplicate_is_not_a_second_delivery(decide: Any) -> None:
    """Copies change neither the forced datagrams nor the consecutive losses."""
    worst = LossOf(loss=WorstCaseLoss())
    alone = decide(LinkSettings(impairments=(worst,), mansd=3), 1000)
    doubled = decide(LinkSettings(impairments=(worst, Duplicate(probability=1.0)), mansd=3), 1000)
    np.testing.assert_array_equal(alone.fates, doubled.fates)
    losses = "consecutive_losses"
    np.testing.assert_array_equal(alone.verdicts[losses], doubled.verdicts[losses])
    assert (doubled.verdicts["copy_ns"] >= 0).sum() == 250


# Many compiled decisions, with an observer in NumPy.

HARSH: dict[str, tuple[AnyImpairment, ...]] = {
    "losses and jitter": (
        LossOf(loss=BernoulliLoss(probability=0.7, correlation=0.8)),
        Delay(delay_s=0.001, jitter_s=0.01, distribution="pareto"),
    ),
    "everything": (
        LossOf(loss=GilbertElliottLoss(good_to_bad=0.1, bad_to_good=0.05, loss_in_bad=0.95)),
        Duplicate(probability=0.5),
        Corrupt(probability=0.6),
        Delay(delay_s=0.005, jitter_s=0.02, distribution="normal", loss_correlation=-0.9),
        Rate(rate_bps=400_000, queue=7),
        Reorder(probability=0.3),
        Delay(jitter_s=0.002, correlation=0.5),
        Blackout(intervals_s=((0.1, 0.9),), every_s=1.0),
    ),
    "overtaking": (Delay(delay_s=1.0), Reorder(probability=0.5), Duplicate(probability=1.0),
                   Delay(jitter_s=3.0), Corrupt(probability=0.5)),
}  # fmt: skip


@pytest.mark.parametrize("harsh", HARSH.values(), ids=HARSH.keys())
@pytest.mark.parametrize("mansd", [0, 1, 4, 30])
@pytest.mark.parametrize("first", [False, True])
def test_the_guarantee_holds_for_hundreds_of_thousands_of_datagrams(
    decide: Any, longest_undelivered: Any, harsh: Any, mansd: int, first: bool
) -> None:
    count = 400_000
    rng = np.random.default_rng(mansd)
    flows = rng.integers(0, 5, count)
    gaps_ns = rng.choice([0, 1, 1000, 500_000, 50_000_000], count, p=[0.3, 0.1, 0.2, 0.38, 0.02])
    settings = LinkSettings(impairments=harsh, mansd=mansd, first_delivered=first, limit=1_000_000)
    decided = decide(settings, count, flows=flows, arrivals_ns=np.cumsum(gaps_ns))
    longest = longest_undelivered(decided)
    assert longest.max() <= mansd
    assert longest.max() == mansd  # the impairments reach the bound


@given(st.integers(0, 3), st.integers(0, 40))
def test_must_pass_is_a_counter(mansd: int, run: int) -> None:
    state = new_flow(0, False)
    state.consecutive_losses = run
    assert isinstance(state, FlowState)
    assert rule.must_pass(state, mansd) == (run >= mansd)
    assert not rule.must_pass(state, -1)
    state.forced_first = 1
    assert rule.must_pass(state, -1)
