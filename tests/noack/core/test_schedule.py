"""The bounds of a schedule are those of its steps, measurements and ticks, enumerated one by one."""

import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest

from netem.core.periods import period_of
from noack.core.schedule import LoopSchedule

RATES_HZ = (1000.0, 500.0, 250.0, 200.0, 100.0, 50.0, 40.0, 25.0, 30.0, 60.0, 90.0, 120.0, 144.0, 59.94, 7.0)
PHASES = (0.0, 0.5, 0.25, 1 / 3, 0.999)
STEPS = 4000
"""Of the plant: schedules of these rates mostly repeat earlier."""
_ROUNDING_NS = 4
"""A bound may be larger by so much where machines round periods: two times differ by 1 ns each, at most."""


def random_schedule(rng: np.random.Generator, **allowed: float) -> LoopSchedule:
    step_hz = float(rng.choice(RATES_HZ))
    tick_hz = step_hz if rng.random() < 0.3 else float(rng.choice(RATES_HZ))
    phase = float(rng.choice(PHASES)) if rng.random() < 0.7 else float(rng.random())
    every = int(rng.choice([1, 1, 2, 5, 7]))
    return LoopSchedule(period_of(step_hz), every, period_of(tick_hz), phase, **allowed)  # type: ignore[arg-type]


def times_of(schedule: LoopSchedule) -> tuple[list[int], list[int], list[int]]:
    """Return the times of steps, measurements and ticks as machines have them."""
    steps = schedule.step.times_ns(np.arange(STEPS)).tolist()
    count = steps[-1] // schedule.tick.lengths_ns[0] + 10
    ticks = (schedule.phase_ns + schedule.tick.times_ns(np.arange(count))).tolist()
    return steps, steps[:: schedule.measure_every], ticks


def until_it_acts(steps: Sequence[int], t_ns: int) -> int | None:
    """Return the first step after a time."""
    number = bisect_right(steps, t_ns)
    return steps[number] if number < len(steps) else None


def from_event(event_ns: int, flight_ns: int, times: tuple[list[int], list[int], list[int]]) -> int | None:
    """Return how long after an event its update acts, which arrives after some time."""
    steps, _, ticks = times
    acts = until_it_acts(steps, ticks[bisect_left(ticks, event_ns + flight_ns)])
    return None if acts is None else acts - event_ns


def ages(schedule: LoopSchedule, times: tuple[list[int], list[int], list[int]]) -> list[int]:
    """Return the age of the input that acts, each time a step replaces it."""
    steps, _, ticks = times
    found = []
    for step, following in pairwise(steps):
        newest = bisect_left(ticks, step) - 1
        if newest >= 0:
            found.append(following - ticks[newest])
    return found


def test_without_delays_each_bound_is_what_happens_at_most() -> None:
    whole = uneven = 0
    for seed in range(80):
        schedule = random_schedule(np.random.default_rng([seed, 1]))
        times, bounds = times_of(schedule), schedule.bounds
        steps, measurements, ticks = times
        between = np.diff(measurements)
        assert (bounds.least_sampling_ns, bounds.sampling_ns) == (between.min(), between.max())
        delays = [delay for t in measurements if (delay := from_event(t, 0, times)) is not None]
        first_ns = until_it_acts(steps, ticks[0])
        assert first_ns is not None
        real = max(delays), max(ages(schedule, times)), first_ns
        over = [bound - found for bound, found in zip(bounds[2:], real, strict=True)]
        assert min(over) >= 0, (seed, over)
        sample, tick = schedule.sample.exact, schedule.tick.exact
        parts = math.lcm(sample.denominator, tick.denominator)
        if math.lcm(int(sample * parts), int(tick * parts)) < parts * steps[-1] / 2:  # all has happened
            assert max(over) <= (0 if schedule.is_whole else _ROUNDING_NS), (seed, over)
            whole += schedule.is_whole
            uneven += not schedule.is_whole
    assert min(whole, uneven) > 15


@pytest.mark.parametrize("seed", range(40))
def test_nothing_takes_longer_with_delays_lateness_and_lost_inputs(seed: int) -> None:
    """Each step, input and update is late or delayed at random, as much as is allowed or not at all."""
    rng = np.random.default_rng([seed, 2])
    late, lost = int(rng.choice([0, 1, 3])), int(rng.choice([0, 1, 2]))
    delay_s, input_delay_ns = float(rng.choice([0.0, 0.003, 0.02])), int(rng.choice([0, 0, 4_000_000]))
    plain = random_schedule(rng)
    gap_ns = lost * plain.tick.longest_ns + input_delay_ns
    schedule = LoopSchedule(
        plain.step, plain.measure_every, plain.tick, plain.phase, late, delay_s, gap_ns,
        predictions=int(rng.integers(1, 4)) if gap_ns else 1,
    )  # fmt: skip
    steps, measurements, ticks = times_of(schedule)
    lateness = rng.choice([0, late], len(steps)) * schedule.step.longest_ns
    driven = np.maximum.accumulate(np.array(steps) + lateness)
    # A run of losses and then an arrival, again and again: inputs that arrive, by the step that is nominal.
    is_lost = np.arange(len(ticks)) % (lost + 1) != 0 if rng.random() < 0.5 else rng.random(len(ticks)) < 0.4
    run = 0
    for k, each in enumerate(is_lost):
        run = run + 1 if each else 0
        if run > lost:
            is_lost[k], run = False, 0
    arrived = [k for k in range(len(ticks)) if not is_lost[k]]
    arrivals = [ticks[k] + input_delay_ns for k in arrived]
    bounds, oldest_tick, oldest_input = schedule.bounds, 0, 0
    for number in range(len(steps) - 1):
        newest = bisect_left(arrivals, steps[number]) - 1
        if newest < 0:
            continue
        tick = arrived[newest]
        due = min(tick + schedule.predictions - 1, bisect_left(ticks, steps[number]) - 1)
        until = int(driven[number + 1])
        oldest_tick = max(oldest_tick, until - ticks[tick])
        oldest_input = max(oldest_input, until - ticks[due])
    assert 0 < oldest_tick <= schedule.oldest_inputs_ns
    assert 0 < oldest_input <= bounds.age_ns
    flight_ns = round(delay_s * 1e9)
    for event in measurements:
        tick = bisect_left(ticks, event + int(rng.choice([0, flight_ns])))
        place = bisect_left(arrived, tick)
        acts = bisect_right(steps, arrivals[place]) if place < len(arrived) else len(steps)
        if acts < len(steps):
            assert int(driven[acts]) - event <= bounds.delay_ns + late * schedule.step.longest_ns
    first_acts = int(driven[bisect_right(steps, arrivals[0])])
    assert first_acts <= bounds.start_ns + late * schedule.step.longest_ns


@pytest.mark.parametrize(
    ("rate_hz", "every", "due_s"),
    [(500.0, 1, 0.5), (30.0, 1, 0.1), (30.0, 1, 0.11), (59.94, 2, 0.25), (7.0, 1, 0.01), (120.0, 7, 1.0)],
)
def test_the_times_between_events_are_those_of_measurements(rate_hz: float, every: int, due_s: float) -> None:
    schedule, due_ns = LoopSchedule(period_of(rate_hz), every, period_of(100.0), 0.0), round(due_s * 1e9)
    measurements = schedule.sample.times_ns(np.arange(20_000)).tolist()
    found = {
        measurements[later] - begin
        for begin in measurements
        if (later := bisect_left(measurements, begin + max(due_ns, 1))) < len(measurements)
    }
    assert schedule.between_events_ns(due_ns) == (min(found), max(found))
