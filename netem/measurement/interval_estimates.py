"""Estimates with confidence intervals: from likelihoods, and exact ones of rates and means.

A likelihood-ratio interval has all values of a parameter that lose at most half the χ² quantile of
log-likelihood. With several parameters, the others are chosen anew for each value (the profile).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats
from scipy.special import chdtri, xlogy

Reals = NDArray[np.float64]
LEVEL = 0.95
"""Nominal coverage of all intervals."""
_ALLOWED = float(chdtri(1, 1 - LEVEL)) / 2
"""Loss of log-likelihood at the ends of an interval."""
_TOLERANCE = 0.01
"""Tolerance of an end of an interval, in the units of the search."""
_LONGEST_STEP = 4.0
"""Largest step outwards of the search for an end."""
_DIFFERENCE = 1e-5
"""Distance of the points from which a gradient is computed."""


class IntervalEstimate(NamedTuple):
    """A value with its confidence interval."""

    value: float
    low: float
    high: float


def binomial_estimate(successes: int, trials: int) -> IntervalEstimate | None:
    """Return a probability with its likelihood-ratio interval; None without trials."""
    if not trials:
        return None
    failures, share = trials - successes, successes / trials

    def lacking(probability: float) -> float:
        log_likelihood = xlogy(successes, probability) + xlogy(failures, 1 - probability)
        return float(xlogy(successes, share) + xlogy(failures, 1 - share) - log_likelihood) - _ALLOWED

    def end(outer: float) -> float:
        return float(optimize.brentq(lacking, share, outer, xtol=1e-15))

    low = end(min(1e-300, share / 2)) if successes else 0.0
    return IntervalEstimate(share, low, end(1 - 1e-16) if failures else 1.0)


def poisson_estimate(count: int, exposure: float) -> IntervalEstimate:
    """Return a rate with its exact interval (Garwood, 1936)."""
    tail = (1 - LEVEL) / 2
    low = float(stats.chi2.ppf(tail, 2 * count)) / 2 if count else 0.0
    high = float(stats.chi2.ppf(1 - tail, 2 * count + 2)) / 2
    return IntervalEstimate(count / exposure, low / exposure, high / exposure)


def exponential_estimate(count: int, total: float) -> IntervalEstimate | None:
    """Return a mean with its exact interval, from the sum of ``count`` values; None without any."""
    if not count:
        return None
    tail = (1 - LEVEL) / 2
    ends = (2 * total / float(stats.chi2.ppf(probability, 2 * count)) for probability in (1 - tail, tail))
    return IntervalEstimate(total / count, *ends)


class Minimum(NamedTuple):
    """A minimum of a function of n parameters."""

    at: Reals
    """(n,)"""
    value: float


def minimise(function: Callable[[Reals], Reals], start: Reals, limit: float) -> Minimum:
    """Return a local minimum with all parameters within ± ``limit``.

    Args:
        function: the values, (j,), at the rows of (j, n). A point and its neighbours, from which
            the gradient follows, are evaluated together.
        start: where the search starts, (n,).
        limit: bound of the parameters' sizes.
    """
    if not len(start):
        return Minimum(start, float(function(start[None])[0]))

    def with_gradient(point: Reals) -> tuple[float, Reals]:
        steps = np.where(point + _DIFFERENCE > limit, -_DIFFERENCE, _DIFFERENCE)
        value, *neighbours = function(np.vstack([point, point + np.diag(steps)]))
        return float(value), (np.array(neighbours) - value) / steps

    result = optimize.minimize(
        with_gradient,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=[(-limit, limit)] * len(start),
        options={"ftol": 1e-10, "gtol": 1e-5, "maxiter": 200},
    )
    return Minimum(np.asarray(result.x), float(result.fun))


def profile_interval(
    function: Callable[[Reals], Reals], best: Minimum, index: int, limit: float
) -> tuple[float, float]:
    """Return the profile-likelihood interval of a parameter, from its minimum outwards.

    Args:
        function: minus the log-likelihoods, (j,), of n parameters each, (j, n).
        best: its minimum.
        index: index of the parameter.
        limit: bound of the parameters' sizes; an interval that reaches it ends there.
    """
    low, high = (_profile_end(function, best, index, sign * limit) for sign in (-1, 1))
    return low, high


def _profile_end(function: Callable[[Reals], Reals], best: Minimum, index: int, outer: float) -> float:
    """Return where the profile has lost what an interval allows, or ``outer``.

    The profile at a value is searched for from the minimum at the last step inside the interval.
    So it is a function of the value alone between two steps, although there may be several local
    minima, and it has the sign that the steps found at both of them.
    """

    def profile(value: float, start: Reals) -> Minimum:
        return minimise(lambda free: function(np.insert(free, index, value, axis=1)), start, abs(outer))

    def lacking(value: float, start: Reals) -> float:
        return profile(value, start).value - limit

    limit = best.value + _ALLOWED
    inside, start, step = float(best.at[index]), np.delete(best.at, index), 0.25
    while inside != outer:
        beyond = inside + float(np.sign(outer)) * min(step, abs(outer - inside))
        following = profile(beyond, start)
        if following.value > limit:
            return float(optimize.brentq(lacking, inside, beyond, args=(start,), xtol=_TOLERANCE))
        inside, start, step = beyond, following.at, min(2 * step, _LONGEST_STEP)
    return outer
