"""A model of outages: they begin at a constant rate, and last for an exponential time."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import expon, goodness_of_fit

from cosim.measurement.confidence_interval import (
    Estimate,
    exponential_estimate,
    poisson_estimate,
)

FEWEST_OUTAGES = 8
"""Number of outages below which the fit is not tested."""
SEED = 20_170_601
"""Of the Monte Carlo test, so that the same trace gives the same number."""


@dataclass(frozen=True)
class OutageFit:
    """Estimates with exact 95 % intervals."""

    count: int
    rate_per_s: Estimate | None
    """Outages per second of time without outage; None: no time was observed."""
    duration_s: Estimate | None
    """Mean duration; None: no outage ended within the trace."""
    p_value: float | None
    """Of the Anderson–Darling test for exponential durations; None: too few outages."""

    @property
    def text(self) -> str:
        """The result of the test in words."""
        if self.p_value is None:
            return f"too few outages for a test of their durations (fewer than {FEWEST_OUTAGES})"
        verdict = "rejected" if self.p_value < 0.01 else "not rejected"
        return f"exponential durations {verdict}: Anderson–Darling, p = {self.p_value:.2g}"


def fit_outages(
    durations_s: NDArray[np.float64], complete: NDArray[np.bool_], observed_s: float
) -> OutageFit:
    """Fit outages.

    Args:
        durations_s: (n,) Their durations.
        complete: (n,) Whether they ended within the trace.
        observed_s: length of the trace.
    """
    without_s = observed_s - float(durations_s.sum())
    rate = poisson_estimate(len(durations_s), without_s) if without_s > 0 else None
    mean = exponential_estimate(int(complete.sum()), float(durations_s.sum()))
    p_value = None
    if len(durations_s) >= FEWEST_OUTAGES and complete.all():
        tested = goodness_of_fit(
            expon, durations_s, known_params={"loc": 0.0}, statistic="ad", n_mc_samples=999,
            rng=np.random.default_rng(SEED),
        )  # fmt: skip
        p_value = float(tested.pvalue)
    return OutageFit(len(durations_s), rate, mean, p_value)
