"""The results of a campaign: claims with their verdicts, every metric at every grid point.

The verdicts of the claims come first, then the summary with its paired differences.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.simulation.exact_simulation import DIVERGED, OK, TOO_MANY_EVENTS, UNDECIDED
from cosim.studies.campaign.campaign_file import Campaign, CampaignClaim, Term, label_of
from cosim.studies.campaign.campaign_grid import Point
from cosim.studies.campaign.chunk_store import Store
from cosim.studies.campaign.metrics import (
    CONFIDENCE,
    METRICS,
    BurstFrequency,
    Estimate,
    Metric,
    PairedDifference,
    burst_frequency,
    compute_metrics,
    difference,
    estimate,
)
from noack.core.linear_systems import Vector
from noack.core.number_format import number

CONFIRMED_FROM, PARTLY_FROM = 0.95, 0.5
"""Least shares of the runs for which a claim is confirmed, and partly confirmed."""
_POINTS_AT_ONCE = 4
"""Number of grid points whose runs are in memory."""
Values = Callable[[Point], Mapping[Metric, Vector]]
"""Returns the metrics of all draws at a grid point, (draws,) each."""


class EvaluatedClaim(NamedTuple):
    """A claim with the shares of the draws in which it holds."""

    says: str
    source: str
    share: float
    """At the first of the grid points that it is about."""
    least: float
    """The smallest share at one of these grid points."""
    least_at: str
    """The labels of this grid point."""
    medians: str
    """The medians of both sides of each condition, at the first grid point."""

    @property
    def verdict(self) -> str:
        """``confirmed``, ``partly`` or ``not confirmed``; the campaign file has the rule."""
        if min(self.share, self.least) >= CONFIRMED_FROM:
            return "confirmed"
        return "partly" if self.share >= PARTLY_FROM else "not confirmed"

    @property
    def reason(self) -> str:
        """The shares and medians in words."""
        least = f" (least: {share_text(self.least)}, {self.least_at})"
        share = f"in {share_text(self.share)} of the draws{'' if self.least == self.share else least}"
        return f"{share}; medians: {self.medians}"


def share_text(share: float) -> str:
    """Return a share in percent; only exactly all or none is written as 100 % or 0 %."""
    text = f"{100 * share:.0f}"
    rounded = text in ("0", "100") and share not in (0.0, 1.0)
    return f"{100 * share:.1f} %" if rounded else f"{text} %"


def evaluate_claims(campaign: Campaign, points: Sequence[Point], values: Values) -> Iterator[EvaluatedClaim]:
    """Yield the claims of a campaign with their verdicts."""
    by_number = {point.number: point for point in points}
    values_of_point = lru_cache(_POINTS_AT_ONCE)(lambda number: values(by_number[number]))
    common = {
        axis: {label_of(value) for value in values_at} for axis, values_at in campaign.claims_at.items()
    }
    for claim in campaign.claims:
        of_claim = {axis: {label_of(value)} for axis, value in claim.where.items()}
        groups: dict[str, list[Point]] = {}
        for point in points:
            allowed = common | of_claim | ({} if claim.axis is None else {claim.axis: point.labels.values()})
            if all(point.labels[axis] in labels for axis, labels in allowed.items()):
                other_labels = (
                    f"{axis} {label}"
                    for axis, label in point.labels.items()
                    if axis != claim.axis and axis not in of_claim
                )
                groups.setdefault(", ".join(other_labels), []).append(point)
        yield _evaluate_claim(claim, groups, lambda point: values_of_point(point.number))


def _evaluate_claim(claim: CampaignClaim, groups: dict[str, list[Point]], values: Values) -> EvaluatedClaim:
    shares, medians = dict[str, float](), ""
    for name, group in groups.items():
        holds, texts = [], []
        for smaller, larger in claim.conditions:
            sides = [_side(term, claim, group, values) for term in (smaller, larger)]
            middles = [np.quantile(side, 0.5, method="inverted_cdf") for side in sides]
            low, high = middles if claim.medians else sides
            holds.append(low < high)
            texts += [
                f"{METRICS[term.metric].heading}{f' at {term.label}' if term.label else ''} "
                + number(METRICS[term.metric].scale * float(middle)).replace("inf", "∞")
                for term, middle in zip((smaller, larger), middles, strict=True)
                if term.metric
            ]
        shares[name] = float(np.mean(np.logical_and.reduce(np.broadcast_arrays(*holds))))
        medians = medians or ", ".join(dict.fromkeys(texts))
    least_at = min(shares, key=shares.__getitem__)
    first = next(iter(shares.values()))
    return EvaluatedClaim(claim.says, claim.source, first, shares[least_at], least_at, medians)


def _side(term: Term, claim: CampaignClaim, group: Sequence[Point], values: Values) -> Vector:
    if term.metric is None:
        return np.array([term.number])
    (point,) = (p for p in group if term.label is None or p.labels[claim.axis or ""] == term.label)
    # A metric that the grid point does not have fulfils no condition.
    return values(point).get(term.metric, np.array([np.nan]))


_ROUNDING = 1e-9
"""A bound is exceeded only by a larger share of it than this."""
_ENDING_NAMES = {
    OK: "finished",
    DIVERGED: "diverged",
    TOO_MANY_EVENTS: "too_many_events",
    UNDECIDED: "undecided",
}


class GridPointResult(NamedTuple):
    """All runs at a grid point."""

    point: Point
    ended: Mapping[str, int]
    """Number of runs by reason of their end."""
    estimates: Mapping[Metric, Estimate]
    breaches: int
    """Number of runs in which ‖e_c‖ exceeds its certified bound: an error in the theory or the
    code."""
    bursts: BurstFrequency | None
    """How often a burst was longer than M − 1; None if the network enforces the guarantee."""


class ComparedResult(NamedTuple):
    """Differences between two grid points, draw by draw."""

    point: Point
    reference: Point
    differences: Mapping[Metric, PairedDifference]


class CampaignSummary(NamedTuple):
    """The results of a campaign."""

    campaign: Campaign
    draws: int
    results: Sequence[GridPointResult]
    compared: Sequence[ComparedResult]
    claims: Sequence[EvaluatedClaim] = ()

    @property
    def breaches(self) -> int:
        """Number of runs in which a certified bound is exceeded."""
        return sum(result.breaches for result in self.results)

    def to_json(self) -> dict[str, object]:
        """The content of ``summary.json``."""
        return {
            "name": self.campaign.name,
            "draws": self.draws,
            "confidence": CONFIDENCE,
            "breaches": self.breaches,
            "points": [
                {
                    "axes": dict(result.point.labels),
                    "ended": dict(result.ended),
                    "certified_error": result.point.certified_error,
                    "bursts": None if result.bursts is None else result.bursts._asdict(),
                    "metrics": {name: e._asdict() for name, e in result.estimates.items()},
                }
                for result in self.results
            ],
            "differences": [
                {
                    "axes": dict(compared.point.labels),
                    "reference": dict(compared.reference.labels),
                    "metrics": {
                        name: {**d.estimate._asdict(), "larger": d.larger, "smaller": d.smaller}
                        for name, d in compared.differences.items()
                    },
                }
                for compared in self.compared
            ],
            "claims": [
                {**claim._asdict(), "verdict": claim.verdict, "reason": claim.reason} for claim in self.claims
            ],
        }


def summarise(campaign: Campaign, store: Store) -> CampaignSummary:
    """Estimate all metrics and evaluate the claims; the runs of a few grid points are in memory."""
    results = [_point_result(point, store) for point in store.points]

    def values(point: Point) -> Mapping[Metric, Vector]:
        return runs_at(point, store)[0]

    claims = list(evaluate_claims(campaign, store.points, values))
    return CampaignSummary(campaign, store.draws, results, list(_comparisons(campaign, store)), claims)


def runs_at(point: Point, store: Store) -> tuple[dict[Metric, Vector], NDArray[np.generic]]:
    """Return all metrics of the runs at a grid point, and the status of each run."""
    columns = store.columns(point.number, store.row_type.names or ())
    return compute_metrics(columns, point.certified_error), columns["status"]


def _point_result(point: Point, store: Store) -> GridPointResult:
    metrics, status = runs_at(point, store)
    bound_shares = metrics.get("certificate_used", np.zeros(0))
    return GridPointResult(
        point,
        {ending: int((status == code).sum()) for code, ending in _ENDING_NAMES.items() if code in status},
        {name: estimate(values) for name, values in metrics.items()},
        int((bound_shares[np.isfinite(bound_shares)] > 1 + _ROUNDING).sum()),
        burst_frequency(point.scenario, metrics),
    )


def _comparisons(campaign: Campaign, store: Store) -> Iterator[ComparedResult]:
    if campaign.compare is None:
        return
    axis, reference_label = campaign.compare.axis, label_of(campaign.compare.reference)
    groups: dict[tuple[str, ...], list[Point]] = {}
    for point in store.points:
        labels = tuple(label for name, label in point.labels.items() if name != axis)
        groups.setdefault(labels, []).append(point)
    for group in groups.values():
        reference = next(point for point in group if point.labels[axis] == reference_label)
        reference_runs, _ = runs_at(reference, store)
        for point in group:
            if point is not reference:
                differences = {
                    name: difference(values, reference_runs[name])
                    for name, values in runs_at(point, store)[0].items()
                    if name in reference_runs
                }
                yield ComparedResult(point, reference, differences)
