"""How long a sensor may sleep: the self-triggered rule's interval, in plain numbers.

The rule is :mod:`noack.trigger.self_triggered`'s. It is interpreted for a live sensor and compiled
for a batch.
"""

import math
from typing import NamedTuple

_HALVINGS = 80
_LARGEST_EXPONENT = 700.0


class Forecast(NamedTuple):
    """What the sensor supposes of its error, and the threshold that it must not pass."""

    beta: float
    """β > 0."""
    alpha_per_s: float
    """α > 0."""
    floor: float
    """ε ≥ 0."""
    growth_per_s: float
    """L ≥ 0."""
    mismatch_per_s: float
    """a ≥ 0."""
    disturbance_per_s: float
    """b ≥ 0."""


def interval_ns(
    forecast: Forecast, size: float, t_s: float, shortest_ns: float, longest_ns: float
) -> float:
    """How long after an event the error may have reached the threshold, in whole nanoseconds.

    Args:
        forecast: what is supposed.
        size: ‖x‖_W at the event.
        t_s: time of the event.
        shortest_ns: the interval is not shorter.
        longest_ns: nor longer.
    """
    low_s, high_s = shortest_ns * 1e-9, longest_ns * 1e-9
    if is_reached(forecast, size, t_s, low_s):
        return shortest_ns
    if not is_reached(forecast, size, t_s, high_s):
        return longest_ns
    # The left side grows and the right one does not: they meet once.
    for _ in range(_HALVINGS):
        if math.floor(low_s * 1e9) == math.floor(high_s * 1e9):
            break
        middle_s = (low_s + high_s) / 2
        if is_reached(forecast, size, t_s, middle_s):
            high_s = middle_s
        else:
            low_s = middle_s
    return float(math.floor(low_s * 1e9))


def is_reached(forecast: Forecast, size: float, t_s: float, tau_s: float) -> bool:
    """Whether the error may have reached the threshold so long after an event."""
    speed = forecast.mismatch_per_s * size + forecast.disturbance_per_s
    exponent = min(forecast.growth_per_s * tau_s, _LARGEST_EXPONENT)
    # The first two terms of the series where the third is below rounding.
    grown = tau_s * (1 + exponent / 2)
    if exponent > 1e-8:
        grown = math.expm1(exponent) / forecast.growth_per_s
    faded = forecast.beta * math.exp(-forecast.alpha_per_s * (t_s + tau_s))
    return speed * grown >= max(faded, forecast.floor)
