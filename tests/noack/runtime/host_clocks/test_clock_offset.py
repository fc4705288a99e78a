"""The bound of the offset of two clocks, whose true offset is known, and clocks that follow it.

Times are whole picoseconds of the own clock, offsets whole 10⁻⁹ ps, so that nothing is rounded but
the readings.
"""

from bisect import bisect_right
from collections.abc import Callable, Iterator
from heapq import heappop, heappush
from random import Random
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from noack.core.clock import RunClock
from noack.core.core_library import core, ffi
from noack.runtime.host_clocks.clock_offset import (
    RELATIVE_RATE_PPB,
    SLEW_PPB,
    ClockOffset,
    Exchange,
    OffsetInterval,
    Restart,
    RestartCause,
    SlewedClock,
    SlewedRunClock,
)

EPOCH_NS = 123_456_789_012_345
speeds = st.sampled_from([0.01, 0.5, 1.0, 2.0, 3.0, 10.0, 1000.0])


def in_core(clock: RunClock) -> Any:
    """Return the clock in the core."""
    made = ffi.new("noack_clock *")
    clock.set_core(made)
    return made


slews = st.integers(1_300_000, 10**9 - 1)


def slewed_clock(begin_ns: int, offset_ns: int, target_ns: int, slew_ppb: int) -> SlewedClock:
    """A clock that has one offset and moves to another one."""
    offset = ClockOffset()
    offset.add(Exchange(begin_ns, begin_ns + offset_ns, begin_ns + offset_ns, begin_ns))
    clock = SlewedClock(offset, begin_ns, slew_ppb)
    sent_ns = begin_ns + 10**9
    offset.add(Exchange(sent_ns, sent_ns + target_ns, sent_ns + target_ns, sent_ns))
    clock.follow(sent_ns)
    return clock


@given(speeds, st.integers(0, 10**12), st.integers(0, 10**13), slews, st.booleans())
def test_a_wait_on_a_slewed_clock_is_never_too_long(
    speed: float, wall_ns: int, wanted_ns: int, slew_ppb: int, ahead: bool
) -> None:
    slewed = slewed_clock(wall_ns, 0, 10**13 if ahead else -(10**13), slew_ppb)
    readings = [wall_ns + 10**9]
    clock = SlewedRunClock(slewed.now_ns(readings[0]), speed, slewed, lambda: readings[-1])
    wait_ns = core.noack_clock_wait_ns(in_core(clock), wanted_ns)
    assert wait_ns <= wanted_ns / speed
    readings.append(readings[0] + wait_ns)
    # The rounding of times of up to 10¹⁵ ns, as above.
    assert clock.now_ns() <= wanted_ns + 2 + 2 * speed


@given(
    speeds, st.integers(0, 10**12), st.integers(-(10**14), 10**14), st.integers(-(10**9), 10**9),
    slews, st.lists(st.integers(0, 10**15), min_size=1, max_size=9),
)  # fmt: skip
def test_the_core_reads_the_same_clocks(
    speed: float, begin_ns: int, offset_ns: int, jump_ns: int, slew_ppb: int, waits: list[int]
) -> None:
    slewed = slewed_clock(begin_ns, offset_ns, offset_ns + jump_ns, slew_ppb)
    readings = [begin_ns + 10**9]
    own: RunClock = RunClock(begin_ns, speed, lambda: readings[-1])
    other: RunClock = SlewedRunClock(begin_ns + offset_ns, speed, slewed, lambda: readings[-1])
    for clock in (own, other):
        other_clock, times_ns = in_core(clock), []
        for wait_ns in sorted(waits):
            readings.append(readings[0] + wait_ns)
            times_ns.append(core.noack_clock_at_ns(other_clock, readings[-1]))
            assert times_ns[-1] == clock.now_ns()
        assert times_ns == sorted(times_ns)


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


def check_run(offset: ClockOffset, random: Random, offset_ns: int, rate_ppb: int, number: int) -> None:
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
offsets_ns = st.sampled_from([0, NS_PER_S, -NS_PER_S, 86_400 * NS_PER_S]) | st.integers(-(10**15), 10**15)
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
        interval = offset.interval(begin_ns + age_ns)
        assert interval is not None
        drift_ns = rate_ppb * age_ns // 10**9
        assert 0 <= interval.upper_ns - (offset_ns + drift_ns) <= 3
        assert 0 <= (offset_ns - drift_ns) - interval.lower_ns <= 3
        assert interval.error_ns == max(
            interval.upper_ns - interval.midpoint_ns, interval.midpoint_ns - interval.lower_ns
        )


def test_an_exchange_that_contradicts_itself_is_not_used() -> None:
    offset = ClockOffset(1000)
    result = offset.add(Exchange(0, 10**9, 2 * 10**9, 10**6))  # 1 s there, 1 ms here
    assert result == Restart(RestartCause.CONTRADICTION, 0, 10**6)
    assert offset.interval(10**6) is None
    assert offset.add(Exchange(10**7, 0, 0, 10**7)) is None
    assert offset.interval(10**7) == (-(10**7) - 2, -(10**7) + 2)


def test_another_clock_begins_again() -> None:
    offset = ClockOffset()
    assert offset.begin_again(5) is None
    offset.add(Exchange(10, 1010, 1010, 20))
    clock = SlewedClock(offset, 20)
    assert offset.begin_again(30) == Restart(RestartCause.OTHER_CLOCK, 20, 30)
    assert offset.interval(30) is clock.error_ns(30) is None
    assert offset.add(Exchange(40, 10**15, 10**15, 50)) is None


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


def known_offset() -> ClockOffset:
    offset = ClockOffset()
    offset.add(exchange_at(10, 0))
    return offset


@pytest.mark.parametrize(
    ("refused", "why"),
    [
        (lambda: RunClock(EPOCH_NS, 0.0), "speed must be positive"),
        (lambda: RunClock(EPOCH_NS, float("nan")), "speed must be positive"),
        (lambda: ClockOffset(-1), "relative rate"),
        (lambda: ClockOffset(10**9), "relative rate"),
        (lambda: ClockOffset().add(Exchange(2, 0, 0, 1)), "wrong order"),
        (lambda: ClockOffset().add(Exchange(0, 2, 1, 5)), "wrong order"),
        (lambda: known_offset().interval(9), "before the newest exchange"),
        (lambda: SlewedClock(ClockOffset(), 0), "no exchange has succeeded"),
        (lambda: SlewedClock(known_offset(), 10, 1_201_000), "slew rate"),
        (lambda: SlewedClock(known_offset(), 10, 10**9), "slew rate"),
    ],
)
def test_impossible_rates_and_times_are_refused(refused: Callable[[], object], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        refused()
