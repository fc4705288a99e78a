"""Outages: loss bursts that are too long for the network's other losses, and their model.

A burst is an outage if its length is implausible, at the level 0.001, in two tests:

* Under Gilbert's chain, burst lengths are geometric. Given the sum S of b lengths, all ways to
  divide S are equally likely, whatever the chain's probabilities. So P(longest ≥ ℓ) is at most
  b C(S − ℓ, b − 1)/C(S − 1, b − 1), as in Fisher's test (1929) of the largest of b values.
* Under the most likely Gilbert–Elliott chain of the trace without the tested bursts,
  P(longest ≥ ℓ) = 1 − (1 − P(length ≥ ℓ))^b.

For k = 1, 2, … the k-th longest burst is tested among those that are not longer, and the largest k
for which both tests reject counts (Rosner, 1975): several outages do not hide each other. In the
model of outages they begin at a constant rate, and last for an exponential time.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.special import gammaln

from netem.measurement.chain_fits import SIGNIFICANCE, ChainFits
from netem.measurement.interval_estimates import IntervalEstimate, exponential_estimate, poisson_estimate
from netem.measurement.loss_bursts import Flags, LossBursts

OUTAGE_LEVEL = 1e-3
"""Nominal probability with which a network without outages has one by this rule."""
MOST_TESTED = 30
"""Number of bursts, the longest, that may be outages."""
FEWEST_BURSTS = 5
"""Number of bursts below which the first test can hardly reject."""
FEWEST_OUTAGES = 8
"""Number of outages below which the fit is not tested."""
SEED = 20_170_601
"""Of the Monte Carlo test, so that the same trace gives the same number."""


@dataclass(frozen=True)
class OutageRule:
    """The bursts that are outages, and why."""

    flags: Flags
    """(b,)"""
    reason: str


def outages_longer_than(durations_s: NDArray[np.float64], least_s: float) -> OutageRule:
    """Classify the bursts that last for ``least_s`` or more, as the user requests."""
    return OutageRule(durations_s >= least_s, f"bursts of {least_s:g} s or more, as given")


def find_outages(bursts: LossBursts) -> OutageRule:
    """Classify bursts by their lengths."""
    count = len(bursts.length)
    order = np.argsort(-bursts.length, kind="stable")
    lengths = bursts.length[order]
    bounds = _longest_burst_bounds(lengths)[: min(MOST_TESTED, count)]
    for k in np.flatnonzero(bounds < OUTAGE_LEVEL)[::-1].tolist():
        if k + 1 < count and lengths[k + 1] == lengths[k]:
            continue  # equal bursts are outages together, or not at all
        flags = np.zeros(count, bool)
        flags[order[: k + 1]] = True
        if _longest_burst_probability(bursts, flags, int(lengths[k]), count - k) < OUTAGE_LEVEL:
            return OutageRule(
                flags,
                f"bursts of {lengths[k]} or more losses: this has a probability below "
                f"{OUTAGE_LEVEL:g} under the fitted chain",
            )
    flags = np.zeros(count, bool)
    if 0 < count < FEWEST_BURSTS:
        return OutageRule(flags, f"only {count} loss bursts: too few to distinguish an outage")
    return OutageRule(flags, "no burst is too long for the fitted chain")


def _longest_burst_bounds(lengths: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return a bound of P(longest ≥ ℓ) for each of descending lengths among those from it on."""
    total = np.cumsum(lengths[::-1])[::-1].astype(float)
    count = np.arange(len(lengths), 0, -1).astype(float)
    spare = total - lengths - (count - 1)  # C(S − ℓ, b − 1) is 0 below 0
    with np.errstate(invalid="ignore"):
        log = (
            np.log(count)
            + gammaln(total - lengths + 1)
            - gammaln(spare + 1)
            - gammaln(total)
            + gammaln(total - count + 1)
        )
    return np.where(spare < 0, 0.0, np.exp(np.minimum(log, 0.0)))


def _longest_burst_probability(bursts: LossBursts, left_out: Flags, length: int, count: int) -> float:
    """Return P(longest of ``count`` bursts ≥ length) under the fit without some bursts."""
    fits = ChainFits(bursts, left_out)
    tail = fits.elliott_rates.survival(lost=True)(np.array([length]))[0]
    return float(-np.expm1(count * np.log1p(-min(tail, 1.0 - 1e-16))))


@dataclass(frozen=True)
class OutageFit:
    """Estimates with exact 95 % intervals."""

    count: int
    rate_per_s: IntervalEstimate | None
    """Outages per second of time without outage; None: no time was observed."""
    duration_s: IntervalEstimate | None
    """Mean duration; None: no outage ended within the trace."""
    p_value: float | None
    """Of the Anderson–Darling test for exponential durations; None: too few outages."""

    @property
    def text(self) -> str:
        """The result of the test in words."""
        if self.p_value is None:
            return f"too few outages for a test of their durations (fewer than {FEWEST_OUTAGES})"
        verdict = "rejected" if self.p_value < SIGNIFICANCE else "not rejected"
        return f"exponential durations {verdict}: Anderson–Darling, p = {self.p_value:.2g}"


def fit_outages(
    durations_s: NDArray[np.float64], complete: NDArray[np.bool_], observed_s: float
) -> OutageFit:
    """Estimate how often outages begin, and how long they last.

    Args:
        durations_s: (n,) Durations of the outages.
        complete: (n,) Whether they ended within the trace.
        observed_s: length of the trace.
    """
    without_s = observed_s - float(durations_s.sum())
    rate = poisson_estimate(len(durations_s), without_s) if without_s > 0 else None
    mean = exponential_estimate(int(complete.sum()), float(durations_s.sum()))
    p_value = None
    if len(durations_s) >= FEWEST_OUTAGES and complete.all():
        test = stats.goodness_of_fit(
            stats.expon,
            durations_s,
            known_params={"loc": 0.0},
            statistic="ad",
            n_mc_samples=999,
            rng=np.random.default_rng(SEED),
        )
        p_value = float(test.pvalue)
    return OutageFit(len(durations_s), rate, mean, p_value)
