from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from noack.core.clock import SLEW_PPB, ClockOffset, Exchange, SlewedClock
from tests.noack.core.true_offsets import PPB, PS, SCALE, TrueOffset, exchanges

slews_ppb = st.sampled_from([1_300_000, SLEW_PPB, PPB - 1])


@given(st.integers(0, 2**32), st.integers(-(10**15), 10**15), slews_ppb)
def test_it_never_runs_backward_and_its_error_is_bounded(
    seed: int, offset_ns: int, slew_ppb: int
) -> None:
    random, offset = Random(seed), ClockOffset()
    begin_ns = random.randint(0, 10**12)
    truth = TrueOffset(random, begin_ns, offset_ns, offset.rate_ppb)
    clock, before_ps, before_ns = None, 0, 0
    for end_ps, exchange in exchanges(random, truth, begin_ns, 300):
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


def test_it_cannot_begin_without_an_offset() -> None:
    with pytest.raises(ValueError, match="no exchange has succeeded"):
        SlewedClock(ClockOffset(), 0)


@pytest.mark.parametrize("slew_ppb", [1_201_000, 10**9])
def test_a_slew_rate_that_cannot_follow_or_runs_backward_is_refused(slew_ppb: int) -> None:
    offset = ClockOffset()
    offset.add(exchange_at(0, 0))
    with pytest.raises(ValueError, match="slew rate"):
        SlewedClock(offset, 0, slew_ppb)
