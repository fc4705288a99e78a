"""Updates that arrive at a tick of the controller, or shortly before it: which tick they act at.

In a live run an update takes some 0.1 ms longer than its nominal delay. So a simulation, which has nominal
times, lets such an update arrive just after the tick.
"""

from fractions import Fraction
from math import floor, gcd

from noack.core.clock import NS_PER_S
from noack.impairments.kinds.delay import Delay
from noack.scenario.resolution import ResolvedRun, resolve
from noack.scenario.scenario import Scenario

LATENCY_NS = 200_000
"""What is nominally so near may come in either order in a live run."""


def with_later_updates(scenario: Scenario) -> tuple[Scenario, str]:
    """Return a scenario whose updates act at the later of two ticks, and in a sentence what was changed.

    The sentence is empty, and the scenario the same, if no constant delay ends at a tick.
    """
    if len(ResolvedRun(scenario).names) > 1:  # loops on one network have their own ticks
        return scenario, ""
    resolved = resolve(scenario)
    stages = resolved.network.impairments
    delays = [stage for stage in stages if isinstance(stage, Delay)]
    if not delays or any(stage.jitter_s or stage.samples_s or stage.file for stage in delays):
        return scenario, ""
    later_ns = _until_after_tick_ns(resolved, sum(round(stage.delay_s * NS_PER_S) for stage in delays))
    if not later_ns:
        return scenario, ""
    place = stages.index(delays[-1])
    delay_s = (round(delays[-1].delay_s * NS_PER_S) + later_ns) / NS_PER_S
    changed = list(scenario.network.impairments)
    changed[place] = delays[-1].model_copy(update={"delay_s": delay_s})
    network = scenario.network.model_copy(update={"impairments": tuple(changed)})
    text = (
        f"an update may arrive at a tick of the controller, or up to {LATENCY_NS / 1e6:g} ms before: a live "
        f"run may use it at this tick or at the next one, here it is the next one (delay_s = {delay_s:.9f})"
    )
    return scenario.model_copy(update={"network": network}), text


def _until_after_tick_ns(resolved: Scenario, delay_ns: int) -> int:
    """Return by how much later updates miss a tick which is near their arrival; 0 if none is."""
    timing = resolved.timing
    sample, tick = timing.measurement_period.exact, timing.controller_period.exact
    unit = sample.denominator * tick.denominator
    common = Fraction(gcd(int(sample * unit), int(tick * unit)), unit)
    until_tick = (timing.exact_controller_phase - delay_ns) % common  # the least of all updates
    return floor(until_tick) + 1 if until_tick <= LATENCY_NS else 0
