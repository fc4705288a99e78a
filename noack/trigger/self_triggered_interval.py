"""The interval of :mod:`noack.trigger.self_triggered`; compiled for a batch of simulations."""

import math
from typing import NamedTuple

_HALVINGS = 80
_LARGEST_EXPONENT = 700.0


class Forecast(NamedTuple):
    """The assumed growth of the sensor's error, and its threshold."""

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
    """Return the time in ns from an event at ``t_s`` until the error may reach the threshold.

    ``size`` is ‖x‖_W at the event. The result is at least ``shortest_ns`` and at most
    ``longest_ns``.
    """
    low_s, high_s = shortest_ns * 1e-9, longest_ns * 1e-9
    if is_reached(forecast, size, t_s, low_s):
        return shortest_ns
    if not is_reached(forecast, size, t_s, high_s):
        return longest_ns
    # The error grows and the threshold does not, so there is one crossing.
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
    """Whether the error may have reached the threshold ``tau_s`` after an event at ``t_s``."""
    speed = forecast.mismatch_per_s * size + forecast.disturbance_per_s
    exponent = min(forecast.growth_per_s * tau_s, _LARGEST_EXPONENT)
    # The first two terms of the series where the third is below rounding.
    grown = tau_s * (1 + exponent / 2)
    if exponent > 1e-8:
        grown = math.expm1(exponent) / forecast.growth_per_s
    faded = forecast.beta * math.exp(-forecast.alpha_per_s * (t_s + tau_s))
    return speed * grown >= max(faded, forecast.floor)
