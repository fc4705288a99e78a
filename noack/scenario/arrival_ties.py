"""Updates that arrive at a tick of the controller, or shortly before it: which tick they act at.

In a live run an update takes some 0.1 ms longer than its nominal delay, and so does an input. So a
simulation, which has nominal times, lets such an update arrive just after the tick.
"""

from collections.abc import Sequence
from fractions import Fraction
from math import floor, gcd

from netem.core.clock import NS_PER_S
from netem.impairments.feature import Impairment
from netem.impairments.kinds.delay import Delay
from noack.scenario.resolution import ResolvedRun
from noack.scenario.scenario import Scenario

LATENCY_NS = 200_000
"""What is nominally so near may come in either order in a live run."""
WITHOUT_DELAY = ("loss", "corrupt", "blackout", "duplicate")
"""Kinds of impairments that do not change the delay of a packet."""
_US = 1000
"""In ns; the later delay is a whole number of µs, as a fraction of a second with few digits."""


def with_later_updates(scenario: Scenario) -> tuple[Scenario, str]:
    """Return a scenario whose updates act at the later of two ticks, and in a sentence what was changed.

    The sentence is empty, and the scenario the same, if no update ends its constant delay at a tick. The
    loops of a run have one network, so that all of them get the same delay.
    """
    stages = scenario.network.impairments
    delays = [stage for stage in stages if isinstance(stage, Delay)]
    is_constant = not any(stage.jitter_s or stage.samples_s or stage.file for stage in delays)
    if not is_constant or any(stage.kind not in ("delay", *WITHOUT_DELAY) for stage in stages):
        return scenario, ""
    loops = [entry.scenario for entry in ResolvedRun(scenario).entries]
    last = delays[-1] if delays else Delay()
    nominal_ns = round(last.delay_s * NS_PER_S)
    others_ns = sum(round(stage.delay_s * NS_PER_S) for stage in delays[:-1])
    later_ns = _later_ns(loops, nominal_ns, others_ns)
    if later_ns == nominal_ns:
        return scenario, ""
    delay_s = later_ns / NS_PER_S
    network = scenario.network.model_copy(update={"impairments": _delayed(stages, last, delay_s)})
    text = (
        f"an update may arrive at a tick of the controller, or up to {LATENCY_NS / 1e6:g} ms before: a live "
        f"run may use it at this tick or at the next one, here it is the next one (delay_s = {delay_s:.6f})"
    )
    return scenario.model_copy(update={"network": network}), text


def late_inputs(scenario: Scenario) -> str:
    """Return in a sentence that inputs may miss a step of the plant.

    The sentence is empty if the network carries inputs, or none is computed shortly before a step. What
    is computed at a step acts at the next one, in every run.
    """
    if scenario.network.actuation is not None:
        return ""
    for entry in ResolvedRun(scenario).entries:
        timing = entry.scenario.timing
        phase, step = timing.exact_controller_phase, timing.plant_period.exact
        if 0 < _until_next(phase, timing.controller_period.exact, step) <= LATENCY_NS:
            return (
                f"an input may be computed up to {LATENCY_NS / 1e6:g} ms before a step of the plant: it is "
                "assumed to act at this step; in a live run it may act at the next one"
            )
    return ""


def _delayed(stages: Sequence[Impairment], last: Delay, delay_s: float) -> tuple[Impairment, ...]:
    """Return the stages with another delay in the place of the last one; without one, at the end."""
    changed = last.model_copy(update={"delay_s": delay_s})
    if last not in stages:
        return (*stages, changed)
    return tuple(changed if stage is last else stage for stage in stages)


def _later_ns(loops: Sequence[Scenario], delay_ns: int, others_ns: int) -> int:
    """Return a delay with which the updates of all loops miss the ticks that are near their arrivals.

    Ticks are near that come at most the live latency after an arrival. Other delays come before this one.
    """
    latest_ns = delay_ns + LATENCY_NS
    while True:
        ticks_ns = [delay_ns + _until_tick_ns(loop, others_ns + delay_ns) for loop in loops]
        near_ns = [floor(tick_ns) for tick_ns in ticks_ns if tick_ns <= latest_ns]
        if not near_ns:
            return delay_ns
        delay_ns = -(-(max(near_ns) + 1) // _US) * _US


def _until_tick_ns(loop: Scenario, delay_ns: int) -> Fraction:
    """Return the least time from the arrival of an update to a tick of the controller."""
    timing = loop.timing
    arrival = Fraction(delay_ns) - timing.exact_controller_phase
    return _until_next(arrival, timing.measurement_period.exact, timing.controller_period.exact)


def _until_next(first: Fraction, period: Fraction, other: Fraction) -> Fraction:
    """Return the least time from one of first, first + period, … to a later multiple of another period."""
    unit = period.denominator * other.denominator
    common = Fraction(gcd(int(period * unit), int(other * unit)), unit)
    return -first % common
