"""The bound of the offset of two clocks whose true offset is known, and the clock that follows it.

Times are whole picoseconds of the own clock, offsets whole 10⁻⁹ ps, so that nothing is rounded but
the readings.
"""

from bisect import bisect_right
from collections.abc import Iterator
from heapq import heappop, heappush
from itertools import pairwise
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from noack.core.clock import (
    RELATIVE_RATE_PPB,
    SLEW_PPB,
    ClockOffset,
    Exchange,
    OffsetInterval,
    Restart,
    RestartCause,
    SlewedClock,
)

PS, PPB = 1000, 10**9
SCALE = PS * PPB
DELAYS_NS = (0, 1, 10**3, 10**5, 10**7, 10**9)


class TrueOffset:
    """Reference minus own clock: pieces with slopes from -rate to rate, often at the limits."""

    def __init__(self, random: Random, begin_ns: int, offset_ns: int, rate_ppb: int) -> None:
        self._random = random
        self._rate_ppb = rate_ppb
        self._begin_ps = [begin_ns * PS]
        self._value = [offset_ns * SCALE]
        self._slope_ppb = [self._drawn()]

    def _drawn(self) -> int:
        rate = self._rate_ppb
        return self._random.choice((-rate, rate, self._random.randint(-rate, rate)))

    def at(self, time_ps: int) -> int:
        """The offset in 10⁻⁹ ps."""
        while time_ps >= self._begin_ps[-1]:
            length_ps = self._random.choice((10**6, 10**8, 10**10)) * PS
            self._value.append(self._value[-1] + self._slope_ppb[-1] * length_ps)
            self._begin_ps.append(self._begin_ps[-1] + length_ps)
            self._slope_ppb.append(self._drawn())
        k = bisect_right(self._begin_ps, time_ps) - 1
        return self._value[k] + self._slope_ppb[k] * (time_ps - self._begin_ps[k])

    def reading_ns(self, time_ps: int) -> int:
        """The reference's clock, rounded down."""
        return (time_ps * PPB + self.at(time_ps)) // SCALE


def exchanges(
    random: Random, truth: TrueOffset, begin_ns: int, number: int
) -> Iterator[tuple[int, Exchange]]:
    """Exchanges in the order of their ends, some of them twice, and the time of each end in ps.

    Each delay has any scale, requests overlap, and some are lost. Receive times may be late.
    """
    sent_ps = begin_ns * PS
    waiting: list[tuple[int, tuple[int, int], Exchange]] = []
    for k in range(number):
        sent_ps += random.randint(0, 10 ** random.choice((4, 7, 8)) * PS)
        forward, answer, back, late, late_there = (
            random.randint(0, random.choice(DELAYS_NS) * PS) for _ in range(5)
        )
        arrived_ps = sent_ps + forward
        answered_ps = arrived_ps + answer
        received_ps = answered_ps + back
        exchange = Exchange(
            sent_ps // PS,
            truth.reading_ns(arrived_ps + min(late_there, answer)),
            truth.reading_ns(answered_ps),
            (received_ps + late) // PS,
        )
        while waiting and waiting[0][0] <= sent_ps:
            end_ps, _, ended = heappop(waiting)
            yield end_ps, ended
        for copy in range(random.choice((0, 1, 1, 1, 2))):
            copied_ps = received_ps + late + copy * random.randint(0, 10**9 * PS)
            heappush(waiting, (copied_ps, (k, copy), exchange))
    for end_ps, _, ended in sorted(waiting):
        yield end_ps, ended


def check_run(
    offset: ClockOffset, random: Random, offset_ns: int, rate_ppb: int, number: int
) -> None:
    """Fail if an interval does not contain the truth, or is wider than the newest exchange."""
    begin_ns = random.randint(0, 10**15)
    truth = TrueOffset(random, begin_ns, offset_ns, rate_ppb)
    for end_ps, exchange in exchanges(random, truth, begin_ns, number):
        assert offset.add(exchange) is None
        time_ps = end_ps + random.choice((0, random.randint(0, 10**8 * PS)))
        for at_ps in (end_ps, time_ps):
            interval = offset.interval(at_ps // PS)
            assert interval is not None
            check_contains(interval, truth.at(at_ps))
            t1, t2, t3, t4 = exchange
            growth_ns = offset.rate_ppb * (2 * (at_ps // PS + 1) - t1 - t4) // PPB
            width_ns = interval.upper_ns - interval.lower_ns
            assert width_ns <= (t2 - t1) + (t4 - t3) + growth_ns + 5


def check_contains(interval: OffsetInterval, truth: int) -> None:
    assert interval.lower_ns * SCALE <= truth <= interval.upper_ns * SCALE


NS_PER_S = 10**9
CHECKS = 500  # exchanges in each of 25 examples
seeds = st.integers(0, 2**32)
offsets_ns = st.sampled_from([0, NS_PER_S, -NS_PER_S, 86_400 * NS_PER_S]) | st.integers(
    -(10**15), 10**15
)
rates_ppb = st.sampled_from([0, 1, 200_000, RELATIVE_RATE_PPB, 10**8])


@given(seeds, offsets_ns, rates_ppb)
def test_the_true_offset_is_in_every_interval(seed: int, offset_ns: int, rate_ppb: int) -> None:
    """With any delays, losses, repetitions and rates within the assumption."""
    offset = ClockOffset(rate_ppb)
    check_run(offset, Random(seed), offset_ns, rate_ppb, CHECKS)
    assert offset.exchanges > CHECKS // 2
    assert offset.restarts == 0


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


slews_ppb = st.sampled_from([1_300_000, SLEW_PPB, PPB - 1])


@given(st.integers(0, 2**32), st.integers(-(10**15), 10**15), slews_ppb)
def test_a_slewed_clock_never_runs_backward_and_its_error_is_bounded(
    seed: int, offset_ns: int, slew_ppb: int
) -> None:
    random, offset = Random(seed), ClockOffset()
    begin_ns = random.randint(0, 10**12)
    truth = TrueOffset(random, begin_ns, offset_ns, offset.rate_ppb)
    clock, before_ps, before_ns = None, 0, 0
    for end_ps, exchange in exchanges(random, truth, begin_ns, 100):
        if clock is not None:
            for time_ps in sorted(random.randint(before_ps, end_ps) for _ in range(3)):
                now_ns = clock.now_ns(time_ps // PS)
                elapsed_ns = time_ps // PS - before_ps // PS
                assert 0 <= now_ns - before_ns <= elapsed_ns + slew_ppb * elapsed_ns // PPB + 2
                before_ps, before_ns = time_ps, now_ns
                error_ns = clock.error_ns(time_ps // PS)
                assert error_ns is not None
                difference = time_ps * PPB + truth.at(time_ps) - now_ns * SCALE
                assert abs(difference) <= error_ns * SCALE
        offset.add(exchange)
        if clock is None:
            clock = SlewedClock(offset, end_ps // PS, slew_ppb)
            before_ns = clock.now_ns(end_ps // PS)
        clock.follow(end_ps // PS)
        before_ps = end_ps
        before_ns = max(before_ns, clock.now_ns(end_ps // PS))


def exchange_at(now_ns: int, offset_ns: int) -> Exchange:
    return Exchange(now_ns, now_ns + offset_ns, now_ns + offset_ns, now_ns)


@pytest.mark.parametrize("jump_ns", [10**6, -(10**6), -(10**12)])
def test_after_a_jump_of_the_offset_it_slews_and_says_how_far_it_lags(jump_ns: int) -> None:
    offset = ClockOffset()
    offset.add(exchange_at(0, 0))
    clock = SlewedClock(offset, 0)
    second_ns = 10**9
    assert offset.add(exchange_at(second_ns, 10 * jump_ns)) is not None
    clock.follow(second_ns)
    assert clock.now_ns(second_ns) == second_ns
    assert clock.error_ns(second_ns) in range(10 * abs(jump_ns), 10 * abs(jump_ns) + 5)
    slewed_ns = clock.now_ns(2 * second_ns) - 2 * second_ns
    assert slewed_ns == (SLEW_PPB if jump_ns > 0 else -SLEW_PPB)
    assert clock.error_ns(2 * second_ns) in range(
        10 * abs(jump_ns) - SLEW_PPB + offset.rate_ppb,
        10 * abs(jump_ns) - SLEW_PPB + offset.rate_ppb + 5,
    )


def test_without_an_offset_there_is_no_error_bound_and_the_rate_is_its_own() -> None:
    offset = ClockOffset()
    offset.add(exchange_at(0, 10**9))
    clock = SlewedClock(offset, 0)
    offset.begin_again(10)
    clock.follow(10)
    assert clock.error_ns(10**9) is None
    assert clock.now_ns(10**9) == 2 * 10**9


def test_a_slewed_clock_cannot_begin_without_an_offset() -> None:
    with pytest.raises(ValueError, match="no exchange has succeeded"):
        SlewedClock(ClockOffset(), 0)


@pytest.mark.parametrize("slew_ppb", [1_201_000, 10**9])
def test_a_slew_rate_that_cannot_follow_or_runs_backward_is_refused(slew_ppb: int) -> None:
    offset = ClockOffset()
    offset.add(exchange_at(0, 0))
    with pytest.raises(ValueError, match="slew rate"):
        SlewedClock(offset, 0, slew_ppb)
