"""The guarantee, checked at the receiver without access to the link's decisions.

At the end: all that the guarantee allows can occur.
"""

import itertools
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from netem.core.core_library import core, ffi
from netem.core.packet_rows import Fate
from netem.impairments.constraints.at_most import AtMost
from netem.impairments.kinds.loss import LossOf
from netem.impairments.kinds.replay import Replay
from netem.impairments.link_settings import LinkSettings
from netem.impairments.loss_models.scripted import ScriptedLoss
from netem.link_state import LinkState
from netem.tc_words import settings_of
from noack.machines.run_channel import Datagram
from tests.netem.impairments import any_link_settings as any_settings
from tests.netem.stepped_link import Link
from tests.oracles.loss_language import allowed_rows, is_allowed, longest_burst

MS = 1_000_000
OUT_OF_ORDER = settings_of("delay 5ms 20ms reorder 50%").impairments


def often_out_of_order(link: LinkSettings, more: bool) -> LinkSettings:
    return link.model_copy(update={"impairments": link.impairments + OUT_OF_ORDER * more})


links = st.builds(
    often_out_of_order, any_settings.harsh.filter(lambda settings: settings.longest_burst is not None),
    st.booleans(),
)  # fmt: skip
GAPS_NS = [0, 1, 1000, MS // 3, MS, 5 * MS, 100 * MS]


def steps_of(seed: int, count: int) -> list[tuple[int, int]]:
    """Flows and gaps, from a seed: most lists that Hypothesis draws itself are short."""
    rng = np.random.default_rng(seed)
    gaps = rng.choice(GAPS_NS, count)
    return list(zip(rng.integers(0, 3, count).tolist(), gaps.tolist(), strict=True))


arrivals = st.builds(steps_of, st.integers(0, 2**32), st.integers(1, 80))


def payload(flow: int, number: int) -> bytes:
    return struct.pack("<HI", flow, number) * 3


class Receiver:
    """Records the numbers of the delivered datagrams of each flow."""

    def __init__(self) -> None:
        self.counted: dict[int, list[int]] = {}

    def take(self, outputs: Sequence[Any]) -> None:
        for output in outputs:
            if not isinstance(output, Datagram):
                continue
            parts = {output.data[k : k + 6] for k in (0, 6, 12)}
            if len(parts) > 1:
                continue
            flow, number = struct.unpack("<HI", parts.pop())
            assert flow == output.flow
            counted = self.counted.setdefault(flow, [])
            if not counted or number > counted[-1]:
                counted.append(number)

    def lost(self, flow: int, sent: int, since: int = 0) -> list[bool]:
        """Return the outcomes of a flow's datagrams from number ``since`` on."""
        counted = set(self.counted.get(flow, ()))
        return [number not in counted for number in range(since, sent)]


def send_all(
    link: Link,
    steps: Sequence[tuple[int, int]],
    late: Callable[[], bool] = lambda: False,
    early: Callable[[], bool] = lambda: False,
    before_each: Callable[[], None] = lambda: None,
) -> tuple[Receiver, dict[int, int]]:
    """Send datagrams at their times; before each, serve the due timers unless ``late()``.

    Timers that are not due are served if ``early()``.
    """
    receiver, sent = Receiver(), dict[int, int]()
    now_ns = 0
    for flow, gap_ns in steps:
        now_ns += gap_ns
        while (due := link.next_deadline_ns()) is not None and (not late() if due <= now_ns else early()):
            receiver.take(link.on_timer(now_ns))
        before_each()
        number = sent.get(flow, 0)
        sent[flow] = number + 1
        receiver.take(link.handle(Datagram(flow, payload(flow, number)), now_ns))
    while (due := link.next_deadline_ns()) is not None:
        now_ns = max(now_ns, due)
        receiver.take(link.on_timer(now_ns))
    return receiver, sent


def assert_kept(settings: LinkSettings, link: Link, receiver: Receiver, sent: Any) -> None:
    """The guarantee holds since the last change; the link counts the bursts that are observed."""
    assert settings.longest_burst is not None
    longest = 0
    for flow, count in sent.items():
        flow_state = link.flow(flow)
        assert flow_state is not None
        lost = receiver.lost(flow, count, flow_state.since)
        assert flow_state.longest_loss_burst == longest_burst(np.array(lost, bool))
        longest = max(longest, flow_state.longest_loss_burst)
        assert is_allowed(lost, settings)
        if settings.first_delivered and flow_state.since == 0:
            assert receiver.counted[flow][0] == 0
    assert link.counters.longest_loss_burst == longest <= settings.longest_burst


@pytest.mark.parametrize("change", ["no", "with the same guarantee", "with another guarantee"])
@given(
    st.lists(links, min_size=2, max_size=4), arrivals, st.integers(0, 2**32),
    st.sampled_from([0.0, 0.3, 0.9]), st.sampled_from([0.0, 0.3]),
)  # fmt: skip
def test_the_guarantee_holds_with_late_and_early_timers_and_changes(
    change: str,
    stages: list[LinkSettings],
    steps: list[tuple[int, int]],
    seed: int,
    late: float,
    early: float,
) -> None:
    """Even if datagrams arrive before overdue timers are served, or leave before they are due.

    And if the settings change.

    Another guarantee holds for all later arrivals, whatever is in flight or was lost before.
    """
    rng = np.random.default_rng(seed)
    in_force = stages[0]
    link = Link(in_force, seed, "a")
    own = {name: getattr(in_force, name) for name in ("mansd", "constraints", "first_delivered")}
    same = change != "with another guarantee"

    def change_sometimes() -> None:
        nonlocal in_force
        if change != "no" and rng.random() < 0.1:
            assert link.counters.longest_loss_burst <= (in_force.longest_burst or 0)
            in_force = stages[int(rng.integers(len(stages)))]
            in_force = in_force.model_copy(update=own) if same else in_force
            link.change(in_force)

    receiver, sent = send_all(
        link, steps, lambda: rng.random() < late, lambda: rng.random() < early, change_sometimes
    )
    assert_kept(in_force, link, receiver, sent)
    if same:  # the same guarantee holds across the changes, too
        assert all(is_allowed(receiver.lost(*of_flow), in_force) for of_flow in sent.items())


@settings(max_examples=30)
@given(links, st.integers(0, 2**32), st.integers(1, 80))
@example(
    settings_of("rate 5mbit queue 50 reorder 100% gap 4 atmost 3 in 4 atmost 3 in 5 recover 2 limit 1"), 0, 10
)  # 1 leaves early; 3 arrives at an earlier time
def test_the_guarantee_needs_no_clock(settings: LinkSettings, seed: int, count: int) -> None:
    """Arrival times in any order, timers served too early."""
    link = Link(settings, 1, "a")
    rng = np.random.default_rng(seed)
    receiver, sent = Receiver(), [0, 0]
    for flow, now_ns in zip(
        rng.integers(0, 2, count).tolist(), rng.integers(0, 10 * MS, count).tolist(), strict=True
    ):
        receiver.take(link.handle(Datagram(flow, payload(flow, sent[flow])), now_ns))
        sent[flow] += 1
        if link.next_deadline_ns() is not None and rng.random() < 0.5:
            receiver.take(link.on_timer(0))
    while link.next_deadline_ns() is not None:
        receiver.take(link.on_timer(0))
    for flow, sent_count in enumerate(sent):
        assert is_allowed(receiver.lost(flow, sent_count), settings)


@pytest.mark.parametrize("served_ms", [0, 20])  # before it is due; or when it is, and the clock runs backward
@pytest.mark.parametrize(
    ("words", "delays_ms", "held_back", "lost"),
    [
        # If 3 left before 2, then 1 would part the burst 0 from the burst 2.
        ("mansd 3 recover 2", [None, 9, 9, 0], 1, [True, False, False, False]),
        # 2 may leave before 1, since 0 is not lost.
        ("mansd 1", [9, 4, 0], 0, [False, True, False]),
        ("atmost 1 in 3", [9, 4, 0], 0, [False, True, False]),
    ],
)
def test_what_has_left_does_not_become_stale(
    served_ms: int, words: str, delays_ms: list[int | None], held_back: int, lost: list[bool]
) -> None:
    """One datagram arrives per ms; the first one that is not lost leaves before the next arrives."""
    outcomes = iter(None if delay_ms is None else delay_ms * MS for delay_ms in delays_ms)
    link, receiver = Link(settings_of(words), 1, "a", network=lambda data, now_ns: next(outcomes)), Receiver()
    for number in range(len(delays_ms)):
        receiver.take(link.handle(Datagram(0, payload(0, number)), number * MS))
        if not receiver.counted and link.next_deadline_ns() is not None:
            receiver.take(link.on_timer(served_ms * MS))
    while link.next_deadline_ns() is not None:
        receiver.take(link.on_timer(0))
    assert receiver.lost(0, len(delays_ms)) == lost
    assert link.counters.held_back == held_back


@given(
    st.lists(st.sampled_from([None, 0, 1, MS, 5 * MS]), min_size=1, max_size=40),
    st.lists(st.sampled_from(GAPS_NS), min_size=1, max_size=60),
    st.integers(0, 4), any_settings.constraints, st.booleans(),
)  # fmt: skip
def test_the_guarantee_holds_whatever_a_network_decides(
    delays_ns: list[int | None], gaps: list[int], mansd: int, constraints: Any, first: bool
) -> None:
    """Also of decisions that no impairment makes. None is a loss."""
    outcomes = itertools.cycle(delays_ns)
    update = {"mansd": mansd, "constraints": constraints}
    settings = settings_of("first" * first).model_copy(update=update)
    link = Link(settings, 1, "a", network=lambda data, now_ns: next(outcomes))
    receiver, sent = send_all(link, [(0, gap) for gap in gaps])
    assert_kept(settings, link, receiver, sent)


@pytest.mark.sanitized
@pytest.mark.parametrize("first", ["mansd 4", "", "delay 1ms", "delay 1ms mansd 1"])
@pytest.mark.parametrize("lost", [0, 1])
def test_datagrams_delivered_before_two_changes_count_as_delivered(first: str, lost: int) -> None:
    """Also those of which the link between knows no release time."""
    link = Link(settings_of(f"loss script {9 if lost else 'none'} {first}"), 1, "a")
    for number in range(10):
        link.decide(0, 100, number * 10 * MS)
    for words in ("delay 1ms mansd 4", "loss worst atmost 2 in 10"):
        link.change(settings_of(words))
    fates = [link.decide(0, 100, t * 10 * MS).fate for t in range(10, 14)]
    assert [fate == core.NOACK_DROPPED for fate in fates] == [True, lost == 0, False, False]


def lost_of(releases: Sequence[int | None]) -> list[bool]:
    """Return the outcomes for the given release times, by brute force."""
    return [
        time is None or any(later is not None and later < time for later in releases[number + 1 :])
        for number, time in enumerate(releases)
    ]


def settle(link: LinkState, packet: int, release_ns: int | None, **copy: int) -> Any:
    """Settle a packet that leaves at a time, or is dropped (None), and its copy; return its decision."""
    fate = core.NOACK_DROPPED if release_ns is None else core.NOACK_DELIVERED
    never = {"copy_ns": -1, "bit": -1, "copy_bit": -1}
    decision = ffi.new("noack_decision *", {"fate": fate, "packet": packet, **never, **copy})
    decision.release_ns = -1 if release_ns is None else release_ns
    core.noack_settle(link.core, 0, decision)
    link.flow(0).packets += 1
    return decision


@pytest.mark.parametrize(
    ("copy", "times"),
    [
        ({"copy_ns": 7}, (10, 10)),
        ({"copy_ns": 12}, (10, 12)),
        ({"bit": 3, "copy_ns": 7}, (4, 10)),  # what leaves corrupted makes nothing stale
    ],
)
def test_a_copy_is_held_back_like_its_datagram(copy: dict[str, int], times: tuple[int, int]) -> None:
    """The copy, too, would make the datagram stale that is to leave before."""
    link = LinkState(settings_of("delay 1s mansd 0"), 0, "a")
    link.start_flow(0, 0)
    settle(link, 0, 10)
    decision = settle(link, 1, 4, **copy)
    assert (decision.release_ns, decision.copy_ns) == times


@settings(max_examples=40)
@given(
    st.lists(st.none() | st.integers(0, 12), max_size=24), st.integers(0, 4),
    any_settings.constraints,
)  # fmt: skip
@example([2, 2, 3, 0], 3, (AtMost(losses=1, window=3),))  # as far back as the cap, but not the window
@example([None, 1, 1, 3, 0], 2, (AtMost(losses=2, window=4),))  # two leave at the same time
def test_a_datagram_is_held_back_no_longer_than_necessary(
    wishes: list[int | None], mansd: int, constraints: Any
) -> None:
    """Compare all times: the earliest at or after the wish that keeps the guarantee is chosen.

    And a datagram must pass only if its loss would break the guarantee.
    """
    own = settings_of(f"delay 1s mansd {mansd}").model_copy(update={"constraints": constraints})
    link = LinkState(own, 0, "a")
    link.start_flow(0, 0)
    releases: list[int | None] = []
    for packet, wish in enumerate(wishes):
        if wish is None:
            must_pass = core.noack_must_pass(link.core, 0)
            assert must_pass != is_allowed([*lost_of(releases), True], own)
            wish = 0 if must_pass else None
        if wish is None:
            settle(link, packet, None)
            releases.append(None)
        else:
            decision = settle(link, packet, wish)
            alternatives = sorted({wish, *(t for t in releases if t is not None and t > wish)})
            least = next(t for t in alternatives if is_allowed(lost_of([*releases, t]), own))
            assert decision.release_ns == least
            assert decision.hold_back_ns == least - wish
            releases.append(least)
        assert is_allowed(lost_of(releases), own)


PAGE = (Path(__file__).parents[3] / "docs/mansd.md").read_text()
NEVER = "–"


def ns(text: str) -> int:
    return core.NOACK_NEVER_NS if text == NEVER else int(text) * 1_000_000


@pytest.mark.parametrize(("words", "column"), [("mansd 1", 3), ("mansd 1 first", 5)])
def test_the_link_decides_the_example_as_documented(words: str, column: int) -> None:
    lines = PAGE.partition("## An example")[2].partition("## Proof")[0].splitlines()
    cells = [line.strip("| ").split(" | ") for line in lines if "|" in line]
    rows = [[cell.strip() for cell in row] for row in cells[2:]]
    assert [int(row[0]) for row in rows] == list(range(6))
    arrivals_ns = [ns(comes) for _, comes, *_ in rows]
    delays_ns = [0 if wish == NEVER else ns(wish) - ns(comes) for _, comes, wish, *_ in rows]
    wishes = Replay(sent_ns=tuple(arrivals_ns), delays_ns=tuple(delays_ns), by="packet")
    lost = LossOf(loss=ScriptedLoss(lost=(3, 4)))  # as the text states
    settings = settings_of(words).model_copy(update={"impairments": (lost, wishes)})
    link = Link(settings, 0, "test")
    for row in rows:
        decision = link.decide(0, 100, ns(row[1]))
        assert decision.release_ns == ns(row[column])
        if column == 3:
            assert (decision.hold_back_ns > 0) == ("held back" in row[4])
            assert (decision.fate == Fate.FORCED) == ("forced" in row[4])


# --- exactly what the guarantee allows ------------------------------------------------------------

LENGTH = 12
"""More than the longest window, and than a burst with the deliveries that must follow it."""
APART = 9
WISHES = np.array(list(itertools.product([False, True], repeat=LENGTH)))
LOST = np.flatnonzero(np.pad(WISHES, ((0, 0), (0, APART)))).tolist()
SCRIPT = (LossOf(loss=ScriptedLoss(lost=tuple(LOST))),)
WINDOWS = [f"atmost {m} in {k}" for k in range(1, 9) for m in range(k)]


@pytest.mark.parametrize("window", [*WINDOWS, "atmost 2 in 4 atmost 3 in 8"])
def test_exactly_the_allowed_sequences_occur(decide: Any, window: str) -> None:
    """For each pair (m, K) with K ≤ 8, and two: alone, with a cap, with recovery, and with both."""
    for cap, recovery in itertools.product(["", "mansd 2"], ["", "recover 3"]):
        own = settings_of(f"{window} {cap} {recovery}")
        scripted = own.model_copy(update={"impairments": SCRIPT})
        fates = decide(scripted, len(WISHES) * (LENGTH + APART)).fates
        lost = ~np.isin(fates, (Fate.DELIVERED, Fate.FORCED))
        occurred = lost.reshape(len(WISHES), LENGTH + APART)[:, :LENGTH]
        allowed, is_wish = allowed_rows(WISHES, own), (occurred == WISHES).all(axis=1)
        assert allowed_rows(occurred, own).all()
        # What is allowed occurs, what is not does not; and nothing is changed before it must be.
        assert (allowed == is_wish).all()
        first = np.argmax(occurred != WISHES, axis=1)[:, None]
        assert np.take_along_axis(WISHES, first, axis=1)[~is_wish].all()
        begun = WISHES & (np.arange(LENGTH) <= first)
        assert not allowed_rows(begun[~is_wish], own).any()
