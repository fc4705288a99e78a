"""The largest sampling period, delay and age of inputs for which a certificate exists.

Each is increased alone. The loop gain grows with it, so its largest value is where the gain is 1.
A rule with times of its own, such as a deadline, has its next test at the first measurement after
them, and this is late for some short sampling periods; such periods count for all longer ones.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import NamedTuple

from noack.core.number_format import at_least
from noack.theory.bounds.certificate_terms import NetworkConditions
from noack.theory.certificates.scenario_certificates import CertificateScope

MOST_S = 10.0
"""No larger times are tried."""
_LEAST_S = 1e-6
"""A smaller limit is 0."""
_USUAL_S = 1e-3
"""TriedSettings first, if the schedule's time is 0."""
_RESOLUTION = 1e-3
"""Relative accuracy of a limit."""
_DIGITS, _SHORTER = 3, (0.0, 0.02, 0.1)
"""Digits of a limit that is printed; by which shares smaller times are tried in its place."""
_WIDER, _NEXT = 4.0, 1.2
"""Factors from a time to the next one until the limit is enclosed: without a guess, and at least."""
_BISECTION_EVERY = 6
"""Every sixth step tries the middle, in case interpolation does not find the limit."""
_JUST_BELOW = 1 - 1e-6
"""Factor from a period to one at which a test is just too early."""
_Points = Sequence[tuple[float, float]]
"""Logarithms of loop gains, and of their times."""


class NetworkLimits(NamedTuple):
    """Largest certified value of each quantity; the others are those of the schedule."""

    sampling_s: float | None
    """None with an observer: its gain belongs to the period of its measurements."""
    delay_s: float
    hold_s: float


def network_limits(scope: CertificateScope, scheduled: NetworkConditions) -> NetworkLimits:
    """Return the limits for some plants, of three digits; 0: there is no certificate at any time.

    Each was tried as it is returned.
    """

    def tried_s(quantity: str) -> float:
        return network_limit(scope, scheduled, quantity, is_short=True)

    sampling_s = None if scope.has_observer else tried_s("sampling")
    return NetworkLimits(sampling_s, tried_s("delay"), tried_s("hold"))


_CHANGES: dict[str, Callable[[NetworkConditions, float], NetworkConditions]] = {
    "sampling": lambda conditions, s: conditions._replace(sampling_s=s, spacing_s=s),
    "delay": lambda conditions, s: conditions._replace(delay_s=s, start_s=s),
    "hold": lambda conditions, s: conditions._replace(hold_s=s),
    "start": lambda conditions, s: conditions._replace(start_s=s),
}


def network_limit(
    scope: CertificateScope, scheduled: NetworkConditions, quantity: str, *, is_short: bool = False
) -> float:
    """Return the limit of one of the times ``sampling``, ``delay``, ``hold`` and ``start``, in s.

    ``is_short``: one of three digits that was tried, that of the schedule if there is no larger one.
    0 means that there is no certificate at any time. With an observer, a sampling period other than
    its own needs another gain, about which this says nothing.
    """
    change = _CHANGES[quantity]
    usual_s: float = getattr(scheduled, f"{quantity}_s")

    @cache
    def gain_at(value_s: float) -> float:
        return scope.loop_gain(change(scheduled, value_s))

    def gain_up_to(value_s: float) -> float:
        if quantity != "sampling":
            return gain_at(value_s)
        shorter_s = _with_late_tests_s(value_s, scope.test_times_s)
        return max(map(gain_at, (value_s, *(t_s for t_s in shorter_s if t_s > usual_s))))

    limit_s = largest_stable_time_s(gain_up_to, usual_s)
    if not is_short or limit_s == 0:
        return limit_s

    def is_certified(value_s: float) -> bool:
        return gain_up_to(value_s) < 1 and scope.certificate(change(scheduled, value_s)).exists

    # The gain need not grow with the time to the last digit, and other inequalities may fail first.
    shorter_s = (float(at_least((1 - share) * limit_s, _DIGITS)) for share in _SHORTER)
    return next((time_s for time_s in shorter_s if time_s >= usual_s and is_certified(time_s)), usual_s)


def _with_late_tests_s(period_s: float, times_s: Sequence[float]) -> Iterator[float]:
    """Yield for each time T the period up to ``period_s`` with the latest test after T.

    It is just below T/k: k tests come before T, and the next one nearly T/k after it.
    """
    for time_s in times_s:
        yield time_s / math.ceil(time_s / period_s) * _JUST_BELOW


def largest_stable_time_s(loop_gain: Callable[[float], float], usual_s: float) -> float:
    """Return the largest time with a loop gain below 1, to 0.1 %, or 0 below 1 µs.

    The gain grows with the time; it is infinite where it is not known.

    Args:
        loop_gain: returns the loop gain at a time in s.
        usual_s: a time in s for which the gain is probably below 1.
    """
    low_s, high_s, known = 0.0, math.inf, list[tuple[float, float]]()
    tried_s, step = min(usual_s or _USUAL_S, MOST_S), 0
    while high_s > _LEAST_S and (math.isinf(high_s) or high_s - low_s > _RESOLUTION * high_s):
        gain = loop_gain(tried_s)
        if 0 < gain < math.inf:
            known.append((math.log(gain), math.log(tried_s)))
        low_s, high_s = (tried_s, high_s) if gain < 1 else (low_s, tried_s)
        if low_s == MOST_S:
            break
        step += low_s > 0 and math.isfinite(high_s)
        tried_s = _next_s(low_s, high_s, known, middle=step % _BISECTION_EVERY == 0)
    return low_s


def _next_s(low_s: float, high_s: float, known: _Points, *, middle: bool) -> float:
    """Return the time to try next, between those with gains below and above 1."""
    guess_s = _interpolated_s(known)
    if low_s == 0:
        return high_s / _WIDER
    if math.isinf(high_s):
        is_found = len(known) > 1 and guess_s > low_s
        guess_s = max(guess_s, _NEXT * low_s) if is_found else _WIDER * low_s
        return min(guess_s, _WIDER**2 * low_s, MOST_S)
    if middle or not low_s < guess_s < high_s:
        return math.sqrt(low_s * high_s)
    # Next to a time that is close to the guess, the next one is on the other side of it.
    margin = 0.9 * _RESOLUTION
    return min(max(guess_s, low_s * (1 + margin)), high_s * (1 - margin))


def _interpolated_s(known: _Points) -> float:
    """Return the time at which the gain is 1, from the gains nearest to it, in logarithms."""
    nearest = sorted(known, key=lambda point: abs(point[0]))[:3]
    interpolated = 0.0
    for gain, time in nearest:
        other_gains = [other_gain for other_gain, _ in nearest if other_gain != gain]
        interpolated += time * math.prod(other_gain / (other_gain - gain) for other_gain in other_gains)
    return math.exp(min(interpolated, math.log(MOST_S)))
