"""Periods and times of a scenario that do not divide each other: what happens instead.

Measurements are at steps of the plant, events at measurements, and inputs take effect at steps.
``noack check`` says these lines, and so does every run.
"""

from netem.core.clock import NS_PER_S
from netem.core.periods import exact_ns
from noack.scenario.scenario import Scenario


def uneven_periods(resolved: Scenario) -> list[str]:
    """Return what differs from the given periods since others are no divisors of them, each as a line."""
    return [*_at_measurements(resolved), *_at_steps(resolved)]


def _at_measurements(resolved: Scenario) -> list[str]:
    """Return the times of the trigger that are no multiples of that between measurements."""
    period_ns = resolved.timing.measurement_period.exact
    lines = []
    for key, (what, time_s) in resolved.trigger.intervals().items():
        periods = exact_ns(time_s) / period_ns
        if periods.denominator > 1:
            real_s = float(-(-periods // 1) * period_ns / NS_PER_S)
            lines.append(f"trigger.{key}: {what} {real_s:g} s, not {time_s:g} s")
    return lines


def _at_steps(resolved: Scenario) -> list[str]:
    """Return how long inputs wait for a step of the plant if these times differ."""
    timing = resolved.timing
    step_ns, tick_ns = timing.plant_period.exact, timing.controller_period.exact
    if 1 in ((tick_ns / step_ns).denominator, (step_ns / tick_ns).denominator):
        return []
    what = "predicted inputs, too, " if resolved.controller.predictions > 1 else ""
    return [
        f"controller.rate_hz: inputs take effect at steps of the plant, {what}"
        f"up to {float(step_ns / NS_PER_S):g} s later: neither period divides the other"
    ]
