"""Sending times by a constant period, and senders that have none."""

import numpy as np
import pytest
from numpy.typing import NDArray

from netem.traces.sending_plan import SendingPlan, plan_sending

PERIOD_NS = 20e6
Reals = NDArray[np.float64]


def plan_of(sent_ns: Reals, delay_ns: Reals, seed: int = 1) -> tuple[SendingPlan, Reals]:
    """Return the plan by the arrivals, of which 2 % are lost, and how far it is from the truth."""
    kept = np.random.default_rng(seed).random(len(sent_ns)) > 0.02
    number = np.flatnonzero(kept)
    received_ns = (sent_ns + delay_ns)[kept]
    origin_ns = received_ns.min()
    plan = plan_sending(number - number[0], (received_ns - origin_ns).astype(np.int64))
    delay_ns = delay_ns[kept]
    return plan, received_ns - origin_ns - plan.sent_ns - (delay_ns - delay_ns.min())


def delays_of(count: int, seed: int) -> dict[str, Reals]:
    rng = np.random.default_rng(seed)
    stalled = rng.exponential(5e6, count)
    length = min(150, count // 10)
    stalled[count // 2 : count // 2 + length] += PERIOD_NS * np.arange(length, 0, -1)
    return {
        "small": rng.exponential(0.1e6, count),
        "a quarter of the period": rng.exponential(5e6, count),
        "many periods": rng.random(count) * 100e6,
        "heavy tail": 2e6 * rng.pareto(1.5, count),
        "stall": stalled,
    }


@pytest.mark.parametrize("count", [70, 300, 3000, 30_000])
@pytest.mark.parametrize("seed", range(4))
def test_a_constant_period_gives_the_delays(count: int, seed: int) -> None:
    for name, delay_ns in delays_of(count, seed).items():
        plan, error_ns = plan_of(np.arange(count) * PERIOD_NS, delay_ns, seed)
        assert not plan.unknown, name
        assert np.abs(error_ns).max() < max(np.quantile(delay_ns, 0.2), 1e6), name


def test_a_trace_that_begins_and_ends_in_stalls_has_known_delays() -> None:
    count = 3000
    delay_ns = delays_of(count, 1)["small"]
    for begin in (0, 1500):
        delay_ns[begin : begin + 80] += np.arange(80, 0, -1) * PERIOD_NS
    plan, error_ns = plan_of(np.arange(count) * PERIOD_NS, delay_ns)
    assert not plan.unknown
    assert np.abs(error_ns).max() < 1e6


def test_few_packets_do_not_show_the_period() -> None:
    assert "fewer than 64" in plan_of(np.arange(50) * PERIOD_NS, np.zeros(50))[0].unknown


@pytest.mark.parametrize("count", [300, 3000, 30_000])
@pytest.mark.parametrize("seed", range(4))
def test_a_sender_without_a_constant_period_has_no_known_delays(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    place = np.arange(count)
    regular = place * PERIOD_NS
    senders = {
        "one pause": regular + 50 * PERIOD_NS * (place > 0.6 * count),
        "a late pause": regular + 10 * PERIOD_NS * (place > 0.93 * count),
        "three pauses": regular + sum(10 * PERIOD_NS * n * (place > n * count / 4) for n in (1, 2, 3)),
        "three every 40 ms": place // 3 * 40e6,
        "10 ms, 30 ms": regular + 10e6 * (place % 2),
        "groups of 3 to 8": np.repeat(33e6 * place, rng.integers(3, 9, count))[:count],
        "at random": np.sort(rng.random(count)) * count * PERIOD_NS,
        "half the rate from then on": regular + np.maximum(place - 0.6 * count, 0) * PERIOD_NS,
    }
    for name, sent_ns in senders.items():
        for delay, delay_ns in list(delays_of(count, seed).items())[:2]:
            assert plan_of(sent_ns, delay_ns, seed)[0].unknown, (name, delay)
