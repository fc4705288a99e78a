"""Confidence intervals from likelihoods, and the exact ones of a Poisson rate."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, minimize
from scipy.special import xlogy
from scipy.stats import chi2

Reals = NDArray[np.float64]
LEVEL = 0.95
"""Nominal coverage of all intervals."""
_ALLOWED = float(chi2.ppf(LEVEL, 1)) / 2
"""Loss of log-likelihood at the ends of an interval."""
_TOLERANCE = 0.01
_LONGEST_STEP = 4.0


class Estimate(NamedTuple):
    """A value with its confidence interval."""

    value: float
    low: float
    high: float


def binomial_estimate(successes: int, trials: int) -> Estimate | None:
    """Return a probability with its likelihood-ratio interval; None without trials."""
    if not trials:
        return None
    failures, share = trials - successes, successes / trials

    def lacking(probability: float) -> float:
        at = xlogy(successes, probability) + xlogy(failures, 1 - probability)
        return float(xlogy(successes, share) + xlogy(failures, 1 - share) - at) - _ALLOWED

    def end(outer: float, certain: bool) -> float:
        return outer if certain else float(brentq(lacking, share, outer, xtol=1e-15))

    low = 0.0 if not successes else end(min(1e-300, share / 2), False)
    return Estimate(share, low, 1.0 if not failures else end(1 - 1e-16, False))


def poisson_estimate(count: int, exposure: float) -> Estimate:
    """Return a rate with its exact interval (Garwood, 1936)."""
    tail = (1 - LEVEL) / 2
    low = float(chi2.ppf(tail, 2 * count)) / 2 if count else 0.0
    high = float(chi2.ppf(1 - tail, 2 * count + 2)) / 2
    return Estimate(count / exposure, low / exposure, high / exposure)


def exponential_estimate(count: int, total: float) -> Estimate | None:
    """Return a mean with its exact interval, from the sum of ``count`` values; None without any."""
    if not count:
        return None
    tail = (1 - LEVEL) / 2
    ends = (2 * total / float(chi2.ppf(at, 2 * count)) for at in (1 - tail, tail))
    return Estimate(total / count, *ends)


class Minimum(NamedTuple):
    """A minimum of a function of n parameters."""

    at: Reals
    """(n,)"""
    value: float


def minimise(function: Callable[[Reals], float], start: Reals, limit: float) -> Minimum:
    """Return a local minimum with all parameters within ± ``limit``."""
    if not len(start):
        return Minimum(start, function(start))
    found = minimize(
        function, start, method="L-BFGS-B", bounds=[(-limit, limit)] * len(start),
        options={"eps": 1e-5, "ftol": 1e-10, "gtol": 1e-5, "maxiter": 200},
    )  # fmt: skip
    return Minimum(np.asarray(found.x), float(found.fun))


def profile_interval(
    function: Callable[[Reals], float], best: Minimum, place: int, limit: float
) -> tuple[float, float]:
    """Return the profile-likelihood interval of a parameter, from its minimum outwards.

    Args:
        function: minus the log-likelihood of n parameters.
        best: its minimum.
        place: place of the parameter.
        limit: bound of the parameters' sizes; an interval that reaches it ends there.
    """
    low, high = (_profile_end(function, best, place, sign * limit) for sign in (-1, 1))
    return low, high


def _profile_end(
    function: Callable[[Reals], float], best: Minimum, place: int, outer: float
) -> float:
    """Return where the profile has lost what an interval allows, or ``outer``.

    The profile at a value is searched for from the minimum at the last step inside the interval.
    So it is a function of the value alone between two steps, although there may be several local
    minima, and it has the sign that the steps found at both of them.
    """

    def profile(value: float, others: Reals) -> Minimum:
        return minimise(lambda rest: function(np.insert(rest, place, value)), others, abs(outer))

    def lacking(value: float, others: Reals) -> float:
        return profile(value, others).value - limit

    limit = best.value + _ALLOWED
    inside, others, step = float(best.at[place]), np.delete(best.at, place), 0.25
    while inside != outer:
        beyond = inside + float(np.sign(outer)) * min(step, abs(outer - inside))
        following = profile(beyond, others)
        if following.value > limit:
            return float(brentq(lacking, inside, beyond, args=(others,), xtol=_TOLERANCE))
        inside, others, step = beyond, following.at, min(2 * step, _LONGEST_STEP)
    return outer
