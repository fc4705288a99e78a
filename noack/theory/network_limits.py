"""The largest sampling period, delay and age of inputs for which a certificate exists."""

import math
from collections.abc import Callable
from typing import NamedTuple

from noack.theory.certificate import NetworkConditions
from noack.theory.scenario_certificates import CertificateScope

MOST_S = 10.0
"""No larger times are tried."""
_LEAST_S, _USUAL_S = 1e-6, 1e-3
_RESOLUTION = 1e-3
_WIDER = 4.0


class NetworkLimits(NamedTuple):
    """Largest certified value of each quantity; the others are those of the schedule."""

    sampling_s: float
    delay_s: float
    hold_s: float


def network_limits(scope: CertificateScope, scheduled: NetworkConditions) -> NetworkLimits:
    """Return the limits for some plants; 0 means that there is no certificate at any time."""

    def limit(change: Callable[[float], NetworkConditions], usual_s: float) -> float:
        return largest(lambda value_s: scope.loop_gain(change(value_s)), usual_s)

    return NetworkLimits(
        limit(lambda v: scheduled._replace(sampling_s=v, spacing_s=v), scheduled.sampling_s),
        limit(lambda v: scheduled._replace(delay_s=v, start_s=v), scheduled.delay_s),
        limit(lambda v: scheduled._replace(hold_s=v), scheduled.hold_s),
    )


def largest(loop_gain: Callable[[float], float], usual_s: float) -> float:
    """Return the largest time with a loop gain below 1, to 0.1 %, or 0 below 1 µs.

    The gain grows with the time; it is infinite where it is not known. It is 1 near the time that
    interpolation gives, so what is tried is that time, then one next to it on the other side, and
    then the middle.

    Args:
        loop_gain: of a time in s.
        usual_s: a time in s for which the gain is probably below 1.
    """
    if loop_gain(MOST_S) < 1:
        return MOST_S
    low, high = (0.0, math.nan), (MOST_S, math.inf)
    tried_s, step = min(usual_s or _USUAL_S, MOST_S / _WIDER), 0
    while high[0] > _LEAST_S and high[0] - low[0] > _RESOLUTION * high[0]:
        gain = loop_gain(tried_s)
        step += 1
        low, high = ((tried_s, gain), high) if gain < 1 else (low, (tried_s, gain))
        if low[0] == 0:
            tried_s = high[0] / _WIDER
        elif math.isinf(high[1]):
            tried_s = min(_WIDER * low[0], math.sqrt(low[0] * high[0]))
        elif step % 3 == 0:
            tried_s = math.sqrt(low[0] * high[0])
        elif step % 3 == 1:
            tried_s = _interpolated(low, high)
        else:  # beyond the time that was interpolated
            near = 0.9 * _RESOLUTION
            tried_s *= 1 + near if gain < 1 else 1 - near
            if not low[0] < tried_s < high[0]:
                tried_s = math.sqrt(low[0] * high[0])
    return low[0]


def _interpolated(low: tuple[float, float], high: tuple[float, float]) -> float:
    """Return the time at which the gain is 1, between two times, in logarithms."""
    (low_s, below), (high_s, above) = low, high
    if not below > 0:
        return math.sqrt(low_s * high_s)
    share = math.log(1 / below) / math.log(above / below)
    share = min(max(share, 0.01), 0.99)
    return low_s * math.exp(share * math.log(high_s / low_s))
