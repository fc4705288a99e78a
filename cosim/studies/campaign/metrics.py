"""The metrics of the runs of a campaign, and their estimates with confidence intervals.

Means have Student's confidence intervals, ± t s/√k. Mean and interval use the finite values only.
The median's interval uses order statistics (binomial, for any distribution). It includes infinite
values: a run that never settles counts as later than all others. Beside the metrics are the
certified bound of ‖e_c‖, and how often runs exceed ``mansd`` losses in a row if the network does not
enforce the guarantee.
"""

import math
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtr, stdtrit

from cosim.simulation.exact_simulation import OK
from netem.guarantee.loss_guarantee import LongestBurst, LossGuarantee
from netem.impairments.markov_chain import NotPredictableError
from netem.impairments.target_loss import loss_process
from noack.core.linear_systems import Vector
from noack.scenario.resolution import loop_of
from noack.scenario.scenario import Scenario
from noack.theory.response_bounds import NotDecayingError, bound_response

Metric = Literal[
    "transmissions",
    "deliveries",
    "lost_share",
    "longest_loss_burst",
    "inter_event_min_s",
    "inter_event_mean_s",
    "settling_s",
    "cost",
    "cost_worst",
    "loops_failed",
    "updates_late",
    "delay_max_s",
    "sup_e_c_scaled",
    "certificate_used",
    "final_norm",
    "output_largest",
]
OF_THRESHOLD: Metric = "sup_e_c_scaled"
"""The metric in units of the threshold at t = 0: it is comparable where α and the norm are the same."""


class Description(NamedTuple):
    """Names of a metric."""

    title: str
    unit: str = ""
    meaning: str = ""
    """Formula, if the title needs one."""
    logarithmic: bool = False
    """Whether the axis of a figure may be logarithmic."""
    scale: float = 1.0
    """Factor from the metric to the number that people read."""

    @property
    def heading(self) -> str:
        """Heading of a column."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title

    @property
    def label(self) -> str:
        """Label of an axis."""
        return f"{self.title} {self.meaning}".strip() + (f" [{self.unit}]" if self.unit else "")


METRICS: Mapping[Metric, Description] = {
    "transmissions": Description("transmissions", logarithmic=True),
    "deliveries": Description("deliveries", logarithmic=True),
    "lost_share": Description("share lost"),
    "longest_loss_burst": Description("longest loss burst"),
    "inter_event_min_s": Description("shortest interval", "s", logarithmic=True),
    "inter_event_mean_s": Description("mean interval", "s", logarithmic=True),
    "settling_s": Description("settling time", "s"),
    "cost": Description("cost", "", "∫ xᵀQx + uᵀRu dt", logarithmic=True),
    "cost_worst": Description("cost of the worst loop", logarithmic=True),
    "loops_failed": Description("share of loops that failed"),
    "updates_late": Description("share of updates that are late"),
    "delay_max_s": Description("largest delay in the network", "s", logarithmic=True),
    "sup_e_c_scaled": Description("sup ‖e_c‖ e^(αt)"),
    "certificate_used": Description("share used", "%", "sup ‖e_c‖ e^(αt) / Δβ", scale=100.0),
    "final_norm": Description("final state", "", "‖x‖", logarithmic=True),
    "output_largest": Description("largest |output|", "", "from metrics.from_s on", logarithmic=True),
}


def compute_metrics(
    columns: Mapping[str, NDArray[np.generic]], certified_bound: float | None
) -> dict[Metric, Vector]:
    """Return all metrics of k runs.

    A time is infinite if its event does not happen. All metrics of a failed run are infinite.
    Without a certified Δβ, the result has no ``certificate_used``.
    """
    values_of: dict[Metric, Vector] = {}
    failed = columns["status"] != OK
    for name in METRICS:
        if name in columns:
            values = np.asarray(columns[name], dtype=np.float64)
            values_of[name] = np.where(np.isnan(values) | failed, np.inf, values)
    delivered_share = columns["deliveries"] / np.maximum(columns["transmissions"], 1)
    values_of["lost_share"] = np.where(failed, np.inf, 1.0 - delivered_share)
    if certified_bound is not None:
        values_of["certificate_used"] = values_of["sup_e_c_scaled"] / certified_bound
    return values_of


def certified_error(resolved: Scenario) -> float | None:
    """Return Δβ with ‖e_c‖_W ≤ Δβe^{−αt} for every plant and every x(0); None if there is none.

    By identity (I1), Δ = 1 + N sup‖W e^{(H+αI)τ} W⁻¹‖ with the longest burst N of lost updates, for any
    inter-event times. It depends on the models only. It exists if the models
    decay faster than the threshold (a zero-order hold does not), the threshold has no floor, and
    the network enforces the guarantee.
    """
    network = resolved.network
    if not resolved.coverage.is_decaying or not network.enforce_mansd:
        return None
    trigger = resolved.decaying
    if trigger.floor > 0:
        return None
    loop = loop_of(resolved)
    weight = np.eye(loop.n) if loop.weight is None else loop.weight
    growing = loop.H + trigger.alpha_per_s * np.eye(loop.n)
    try:
        gain = bound_response(growing, weight, np.linalg.inv(weight)).largest
    except NotDecayingError:
        return None
    return (1.0 + network.longest_burst * gain) * trigger.beta


CONFIDENCE = 0.95
"""Of all intervals."""
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
"""A quantile is the smallest value that at least this share of the draws does not exceed."""


class Estimate(NamedTuple):
    """A metric over k draws."""

    draws: int
    finite: int
    """Number of draws with a finite metric; mean and interval use only these."""
    mean: float
    halfwidth: float
    """Half-width of the mean's 95 % confidence interval."""
    q05: float
    q25: float
    median: float
    q75: float
    q95: float
    median_low: float
    """Lower end of the median's 95 % confidence interval."""
    median_high: float
    largest: float


def estimate(values: Vector, finite: Vector | None = None) -> Estimate:
    """Estimate a metric from its values in k ≥ 1 draws, (k,), without NaN.

    Mean and interval use ``finite``, by default all finite values.
    """
    finite = values[np.isfinite(values)] if finite is None else finite
    mean, halfwidth = float(finite.mean()) if len(finite) else math.inf, math.inf
    if len(finite) > 1:
        with np.errstate(over="ignore"):  # the interval of numbers beyond 1e150 is infinite
            deviation = float(finite.std(ddof=1))
        halfwidth = _student(len(finite)) * deviation / math.sqrt(len(finite))
    q05, q25, median, q75, q95 = _quantiles(values, QUANTILES)
    low, high = quantile_interval(values, 0.5)
    largest = float(values.max())
    return Estimate(
        draws=len(values),
        finite=len(finite),
        mean=mean,
        halfwidth=halfwidth,
        q05=q05,
        q25=q25,
        median=median,
        q75=q75,
        q95=q95,
        median_low=low,
        median_high=high,
        largest=largest,
    )


def to_shown_unit(metric: Metric, estimate: Estimate) -> Estimate:
    """Return mean and interval in the unit of the metric's description."""
    scale = METRICS[metric].scale
    return estimate._replace(mean=scale * estimate.mean, halfwidth=scale * estimate.halfwidth)


def paired_differences(values: Vector, reference: Vector) -> Vector:
    """Return ``values`` − ``reference`` draw by draw; 0 if both are infinite."""
    with np.errstate(invalid="ignore"):
        return np.where(values == reference, 0.0, values - reference)


class PairedDifference(NamedTuple):
    """Difference of a metric between two grid points, draw by draw."""

    estimate: Estimate
    larger: float
    """Share of the draws in which the metric is larger than at the reference."""
    smaller: float
    """Share of the draws in which the metric is smaller than at the reference."""


def difference(values: Vector, reference: Vector) -> PairedDifference:
    """Estimate ``values`` − ``reference``, (k,) each.

    If both are infinite, the quantiles use a difference of 0, and the mean omits the draw.
    """
    differences = paired_differences(values, reference)
    are_finite = np.isfinite(values) & np.isfinite(reference)
    return PairedDifference(
        estimate(differences, differences[are_finite]),
        float((values > reference).mean()),
        float((values < reference).mean()),
    )


@cache
def _student(count: int) -> float:
    """Return Student's factor t for the mean of this number of values."""
    return float(stdtrit(count - 1, (1 + CONFIDENCE) / 2))


def _quantiles(values: Vector, shares: Sequence[float]) -> list[float]:
    return [float(value) for value in np.quantile(values, shares, method="inverted_cdf")]


def quantile_interval(values: Vector, share: float) -> tuple[float, float]:
    """Return the ends of a quantile's 95 % confidence interval; ±inf if no draw bounds it."""
    ascending = np.append(np.sort(values), math.inf)
    low, high = interval_ranks(len(values), share)
    return float(ascending[low]) if low >= 0 else -math.inf, float(ascending[high])


@cache
def interval_ranks(count: int, share: float) -> tuple[int, int]:
    """Return the ranks, from 0, of the ends of a quantile's 95 % confidence interval.

    They are −1 and ``count`` if no draw bounds the quantile.
    """
    # The j-th smallest draw, from 1, exceeds the quantile if fewer than j draws lie below it.
    tail = (1.0 - CONFIDENCE) / 2
    below_probability = bdtr(np.arange(count + 1), count, share)
    low, high = np.searchsorted(below_probability, (tail, 1.0 - tail)).tolist()
    return low - 1, min(high, count)


class BurstFrequency(NamedTuple):
    """Runs with a burst of more than ``mansd`` losses, and their predicted share."""

    most: int
    """``mansd``."""
    runs: int
    longer: int
    """Number of runs with a longer burst."""
    low: float
    """Low end of the confidence interval of their share (Clopper and Pearson)."""
    high: float
    packets: int
    """Largest number of packets of a run."""
    predicted: float
    """Probability of a longer burst in this number of packets: an upper bound for the share."""

    @property
    def text(self) -> str:
        """The comparison, as part of a sentence."""
        return (
            f"{self.longer:,} of {self.runs:,} runs ({100 * self.longer / self.runs:.3g} %, "
            f"interval {100 * self.low:.3g} to {100 * self.high:.3g} %) had a burst longer than "
            f"{self.most}; at most {100 * self.predicted:.3g} % are expected, since no run "
            f"sent more than {self.packets:,} packets"
        )


def burst_frequency(scenario: Scenario, metrics: Mapping[Metric, Vector]) -> BurstFrequency | None:
    """Compare; None if the network enforces the guarantee, or the losses change or cannot be predicted."""
    network = scenario.network
    if network.enforce_mansd or scenario.loops or scenario.changes:
        return None
    bursts, packets = metrics["longest_loss_burst"], metrics["transmissions"]
    finished = np.isfinite(bursts)
    longer, runs = int((bursts[finished] > network.mansd).sum()), int(finished.sum())
    if not runs:
        return None
    from scipy.stats import binomtest  # slow to import

    interval = binomtest(longer, runs).proportion_ci(CONFIDENCE)
    most = int(packets[finished].max())
    try:
        chance = loss_process(network.link).keeps(LossGuarantee((LongestBurst(network.mansd),)), most)
    except NotPredictableError:
        return None
    return BurstFrequency(
        network.mansd, runs, longer, float(interval.low), float(interval.high), most, 1 - chance
    )
