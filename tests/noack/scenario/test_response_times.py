"""The bounds of a link that chooses what it sends, against a published example and arrivals."""

import math
import pickle
from itertools import product
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from netem.channel import Channel
from netem.link_state import LinkState
from noack.impairments.disciplines.earliest_deadline import EarliestDeadline
from noack.impairments.disciplines.maximum_error import MaximumError
from noack.impairments.disciplines.priority import Priority
from noack.impairments.feature import Scheduler
from noack.impairments.kinds.rate import Rate
from noack.impairments.link_settings import LinkSettings
from noack.scenario.link_load import link_loads
from noack.scenario.parameter_changes import settings_key
from noack.scenario.resolution import loop_named, resolve, resolved_loops
from noack.scenario.response_times import Sender, response_ns
from noack.scenario.scenario import Scenario, loop_names
from noack.theory.certificates.conditions import allowed_conditions, certified_delay_s, network_delay_texts
from tests.helpers.shipped import shipped
from tests.netem.stepped_channel import send

US = 1000
LOWER, HIGHER = -math.inf, math.inf


@pytest.mark.parametrize(
    ("own", "others", "expected_us"),
    [
        ((2500, 0), {(3500, LOWER): 2}, 2000),
        ((3500, 0), {(2500, HIGHER): 1, (3500, LOWER): 1}, 3000),
        ((3500, 0), {(2500, HIGHER): 1, (3500, HIGHER): 1}, 3500),
    ],
)
def test_the_published_response_times(own: Any, others: Any, expected_us: int) -> None:
    """Messages A, B and C of 1 ms: Davis, Burns, Bril and Lukkien 2007; C's second one is worst."""
    senders = {Sender(d * US, 1000 * US, after): n for (d, after), n in others.items()}
    assert response_ns(Sender(own[0] * US, 1000 * US), senders) == expected_us * US


def test_loops_that_need_the_whole_link_have_no_bound() -> None:
    assert response_ns(Sender(100, 50), {Sender(100, 50): 1}) == math.inf
    assert response_ns(Sender(100, 50), {Sender(100, 49): 1}) < math.inf


def longest_ns(scheduler: Scheduler, sizes: Any, arrivals: Any) -> list[int]:
    """Return the longest delay of each flow's packets on a link that sends a byte in 1 us.

    Of arrivals at the same time, in us, those with the least second number come first; their error
    levels follow from it, too.
    """
    rate = Rate(rate_bps=8_000_000, overhead_bytes=0, discipline=scheduler)
    link = LinkState(LinkSettings(impairments=(rate,)), 0, "x", rows=len(sizes))
    channel, longest = Channel([link], loops=len(sizes)), [0] * len(sizes)
    sent_ns: list[list[int]] = [[] for _ in sizes]

    def let_out(until_ns: int) -> None:
        while (due_ns := channel.due_ns) <= until_ns:
            for packet in channel.release(due_ns):
                own_ns = due_ns - sent_ns[packet.flow][packet.number]
                longest[packet.flow] = max(longest[packet.flow], own_ns)

    for t_us, second, flow in sorted(arrivals):
        let_out(t_us * US)
        sent_ns[flow].append(t_us * US)
        send(channel, flow, len(sent_ns[flow]) - 1, sizes[flow], t_us * US, 7 * second % 256)
    let_out(2**60)
    return longest


def bounds_ns(scheduler: Scheduler, sizes: Any, least_us: Any) -> list[float]:
    flows = range(len(sizes))
    bounds_ns = []
    for flow in flows:
        kinds: dict[Sender, int] = {}
        for other in flows:
            yields_ns = scheduler.yields_ns(scheduler.number(flow), scheduler.number(other))
            kind = Sender(least_us[other] * US, sizes[other] * US, yields_ns)
            kinds[kind] = kinds.get(kind, 0) + (other != flow)
        others = {kind: count for kind, count in kinds.items() if count}
        bounds_ns.append(response_ns(Sender(least_us[flow] * US, sizes[flow] * US), others))
    return bounds_ns


def scheduler_of(numbers: Any, kind: type[Scheduler]) -> Scheduler:
    if kind is MaximumError:
        return MaximumError()
    if kind is EarliestDeadline:
        return EarliestDeadline(deadlines_s=tuple(number * 40e-6 for number in numbers))
    return Priority(levels=tuple(numbers))


@settings(max_examples=75)
@given(
    st.lists(
        st.tuples(st.integers(1, 40), st.integers(60, 200), st.integers(0, 3)),
        min_size=1,
        max_size=5,
    ),
    st.sampled_from([Priority, EarliestDeadline, MaximumError]),
    st.data(),
)
def test_no_arrivals_exceed_the_bound(loops: Any, kind: type[Scheduler], data: st.DataObject) -> None:
    sizes, least_us, numbers = zip(*loops, strict=True)
    scheduler = scheduler_of(numbers, kind)
    arrivals = []
    for flow, least in enumerate(least_us):
        gap_us = st.sampled_from([0, 0, 0, 1, 7]) | st.integers(0, 100)
        now_us = data.draw(gap_us)
        for late_us in data.draw(st.lists(gap_us, min_size=1, max_size=12)):
            arrivals.append((now_us, data.draw(st.integers(0, 9)), flow))
            now_us += least + late_us
    longest = longest_ns(scheduler, sizes, arrivals)
    for own_ns, bound_ns in zip(longest, bounds_ns(scheduler, sizes, least_us), strict=True):
        assert own_ns <= bound_ns


def test_the_loops_of_each_bound_are_named() -> None:
    """Updates take 2.5 ms each, 10 ms apart; loops 0 to 2 need three quarters of the rate."""
    levels = "network.impairments.0.discipline.levels=[1,2,1,3]"
    (load,) = link_loads(shipped("priority_channel", levels, "loops=[{name='p',count=5}]"))
    bounds = (("p-1, p-3", 0.0075), ("p-2", 0.01), ("p-4 to p-5", math.inf))
    assert load.loop_bounds == bounds
    assert load.delay_bound_s is None


@pytest.mark.parametrize(
    ("settings", "delays_s", "says"),
    [
        ([], [0.005, 0.0075, 0.0075], "up to {} ms in virtual time, if each of the 3 loops keeps"),
        (["loops=[{name='p'}]"], [0.0025], "up to {} ms in virtual time, if its loop keeps"),
        # Five loops need more than the rate: the last three have a full queue of long packets.
        (["loops=[{name='p',count=5}]"], [0.005, 0.0075, *[4 * 12_000 / 294_400] * 3], "no bound"),
        (["certificate.network_delay_s=0.02"], [0.02] * 3, "network_delay_s allows for a delay of {} ms"),
        (["network.impairments=[{kind='delay',delay_s=0.003}]"], [0.003] * 3, "delays updates by up to"),
    ],
)  # fmt: skip
def test_certificates_allow_for_the_proven_delay_of_the_loop_in_its_run(
    settings: list[str], delays_s: list[float], says: str
) -> None:
    run = shipped("priority_channel", *settings)
    loops = resolved_loops(run)
    assert [certified_delay_s(loop) for loop in loops] == pytest.approx(delays_s)
    assert says.format(f"{1e3 * delays_s[-1]:g}") in "".join(network_delay_texts(loops[-1]))
    for loop, name in zip(loops, loop_names(run), strict=True):
        assert certified_delay_s(resolve(loop_named(run, name))) == certified_delay_s(loop)
        assert allowed_conditions(loop).delay_s == allowed_conditions(copy_of(loop)).delay_s


def test_loops_with_equal_delays_share_their_settings() -> None:
    """The machines of such loops are filled once, and copied."""
    loops = resolved_loops(shipped("priority_channel", "loops=[{name='p',count=5}]"))
    keys = [*map(settings_key, loops)]  # the delays of the first two loops are others
    assert [keys.index(key) for key in keys] == [0, 1, 2, 2, 2]


def copy_of(loop: Scenario) -> Scenario:
    """Return the loop as another process receives it."""
    copied: Scenario = pickle.loads(pickle.dumps(loop))
    return copied


@pytest.mark.parametrize("kind", [Priority, EarliestDeadline])
def test_the_bound_is_reached_for_distinct_numbers(kind: type[Scheduler]) -> None:
    """Of 800 starts of three periodic flows, the worst one reaches each bound."""
    sizes, least_us, scheduler = (30, 20, 50), (131, 173, 307), scheduler_of((1, 3, 5), kind)
    worst = [0, 0, 0]
    for (second, third), order in product(product(range(0, 200, 10), repeat=2), (1, -1)):
        starts = (0, second, third)
        arrivals = [
            (starts[flow] + k * least_us[flow], order * flow, flow)
            for flow in range(3) for k in range(4)
        ]  # fmt: skip
        worst = [*map(max, worst, longest_ns(scheduler, sizes, arrivals))]
    assert worst == bounds_ns(scheduler, sizes, least_us) == [80 * US, 100 * US, 100 * US]
