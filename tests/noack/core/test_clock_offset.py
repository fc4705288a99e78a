from itertools import pairwise
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from noack.core.clock import (
    RELATIVE_RATE_PPB,
    ClockOffset,
    Exchange,
    OffsetInterval,
    Restart,
    RestartCause,
)
from tests.noack.core.true_offsets import PS, TrueOffset, check_contains, check_run

NS_PER_S = 10**9
CHECKS = 4000  # times 25 examples: 10⁵
seeds = st.integers(0, 2**32)
offsets_ns = st.sampled_from([0, NS_PER_S, -NS_PER_S, 86_400 * NS_PER_S]) | st.integers(
    -(10**15), 10**15
)
rates_ppb = st.sampled_from([0, 1, 200_000, RELATIVE_RATE_PPB, 10**8])


@given(seeds, offsets_ns, rates_ppb)
def test_the_true_offset_is_in_every_interval(seed: int, offset_ns: int, rate_ppb: int) -> None:
    """With any delays, losses, repetitions and rates within the assumption, 10⁵ times in all."""
    offset = ClockOffset(rate_ppb)
    check_run(offset, Random(seed), offset_ns, rate_ppb, CHECKS // 2)
    assert offset.exchanges > CHECKS // 3
    assert offset.restarts == 0


class RateOfZero(ClockOffset):
    def __init__(self) -> None:
        super().__init__(0)


class ExchangedTimestamps(ClockOffset):
    """Takes the reply's sending time for the request's arrival."""

    def add(self, exchange: Exchange) -> Restart | None:
        t1, _, t3, t4 = exchange
        return super().add(Exchange(t1, t3, t3, t4))


class ExchangedTimestampsOfReply(ClockOffset):
    """Takes the request's arrival for the reply's sending time."""

    def add(self, exchange: Exchange) -> Restart | None:
        t1, t2, _, t4 = exchange
        return super().add(Exchange(t1, t2, t2, t4))


class AssumedSymmetry(ClockOffset):
    """Takes the midpoint for the offset, as if both delays were equal."""

    def interval(self, now_ns: int) -> OffsetInterval | None:
        found = super().interval(now_ns)
        return found and OffsetInterval(found.midpoint_ns - 1, found.midpoint_ns + 1)


class NotRoundedOutward(ClockOffset):
    def interval(self, now_ns: int) -> OffsetInterval | None:
        found = super().interval(now_ns)
        return found and OffsetInterval(found.lower_ns + 2, found.upper_ns - 2)


@pytest.mark.parametrize(
    "broken",
    [
        RateOfZero,
        ExchangedTimestamps,
        ExchangedTimestampsOfReply,
        AssumedSymmetry,
        NotRoundedOutward,
    ],
)
def test_the_check_finds_a_mistake(broken: type[ClockOffset]) -> None:
    with pytest.raises(AssertionError):
        check_run(broken(), Random(1), NS_PER_S, RELATIVE_RATE_PPB, CHECKS)


@given(rates_ppb, offsets_ns, st.lists(st.integers(0, 10**12), min_size=1, max_size=20))
def test_the_bound_is_attained(rate_ppb: int, offset_ns: int, ages_ns: list[int]) -> None:
    """No smaller interval would be right: without delay and with the assumed rate, truth is at it.

    The reading and the elapsed time are each known to 1 ns.
    """
    offset = ClockOffset(rate_ppb)
    begin_ns = 10**9
    there_ns = begin_ns + offset_ns
    offset.add(Exchange(begin_ns, there_ns, there_ns, begin_ns))
    for age_ns in ages_ns:
        found = offset.interval(begin_ns + age_ns)
        assert found is not None
        drift_ns = rate_ppb * age_ns // 10**9
        assert 0 <= found.upper_ns - (offset_ns + drift_ns) <= 3
        assert 0 <= (offset_ns - drift_ns) - found.lower_ns <= 3
        assert found.error_ns == max(
            found.upper_ns - found.midpoint_ns, found.midpoint_ns - found.lower_ns
        )


@given(seeds, st.sampled_from([-1, 1]), st.integers(2, 20))
def test_a_violated_rate_is_reported_and_the_bound_begins_again(
    seed: int, sign: int, factor: int
) -> None:
    """The report names a time before which the bound was right."""
    random, rate_ppb = Random(seed), 100_000
    offset = ClockOffset(rate_ppb)
    violated_ns = 50 * 10**9

    def theta_ns(now_ns: int) -> int:
        return sign * factor * rate_ppb * max(0, now_ns - violated_ns) // 10**9

    restarts = []
    for sent_ns in range(0, 100 * 10**9, 10**8):
        forward_ns, back_ns = random.randint(0, 10**5), random.randint(0, 10**5)
        there_ns = sent_ns + forward_ns
        received_ns = there_ns + back_ns
        there_ns += theta_ns(there_ns)
        found = offset.add(Exchange(sent_ns, there_ns, there_ns, received_ns))
        interval = offset.interval(received_ns)
        assert interval is not None
        if found is not None:
            restarts.append(found)
            assert found.cause is RestartCause.CONTRADICTION
            assert found.now_ns == received_ns > violated_ns
            assert found.since_ns < received_ns
            # The new bound is that of this exchange alone, during which the rate was violated.
            slack_ns = factor * rate_ppb * (received_ns - sent_ns) // 10**9 + 1
            assert interval.lower_ns - slack_ns <= theta_ns(received_ns)
            assert theta_ns(received_ns) <= interval.upper_ns + slack_ns
        if received_ns <= violated_ns:
            assert interval.lower_ns <= theta_ns(received_ns) <= interval.upper_ns
    assert offset.restarts == len(restarts) > 0
    # Contradictions appear once the excess is more than the width: 200 µs at 100 ppm or more, 2 s.
    assert restarts[0].now_ns < violated_ns + 3 * 10**9
    assert restarts[0].since_ns >= violated_ns - 3 * 10**9


def test_an_exchange_that_contradicts_itself_is_not_used() -> None:
    offset = ClockOffset(1000)
    found = offset.add(Exchange(0, 10**9, 2 * 10**9, 10**6))  # 1 s there, 1 ms here
    assert found == Restart(RestartCause.CONTRADICTION, 0, 10**6)
    assert offset.interval(10**6) is None
    assert offset.add(Exchange(10**7, 0, 0, 10**7)) is None
    assert offset.interval(10**7) == (-(10**7) - 2, -(10**7) + 2)


def test_another_clock_begins_again() -> None:
    offset = ClockOffset()
    assert offset.begin_again(5) is None
    offset.add(Exchange(10, 1010, 1010, 20))
    assert offset.begin_again(30) == Restart(RestartCause.OTHER_CLOCK, 20, 30)
    assert offset.interval(30) is None
    assert offset.add(Exchange(40, 10**15, 10**15, 50)) is None


@pytest.mark.parametrize("exchange", [Exchange(2, 0, 0, 1), Exchange(0, 2, 1, 5)])
def test_timestamps_in_the_wrong_order_are_refused(exchange: Exchange) -> None:
    with pytest.raises(ValueError, match="wrong order"):
        ClockOffset().add(exchange)


def test_no_answer_is_given_for_the_past() -> None:
    offset = ClockOffset()
    offset.add(Exchange(10, 10, 10, 20))
    with pytest.raises(ValueError, match="before the newest exchange"):
        offset.interval(19)


@pytest.mark.parametrize("rate_ppb", [-1, 10**9])
def test_an_impossible_rate_is_refused(rate_ppb: int) -> None:
    with pytest.raises(ValueError, match="relative rate"):
        ClockOffset(rate_ppb)


def test_the_true_offset_stays_within_its_rate() -> None:
    truth = TrueOffset(Random(3), 0, 10**9, 1000)
    values = [truth.at(k * 10**6 * PS) for k in range(1000)]
    steps = [abs(b - a) for a, b in pairwise(values)]
    assert 0 < max(steps) <= 1000 * 10**6 * PS
    check_contains(OffsetInterval(10**9 - 10**6, 10**9 + 10**6), values[-1])
