"""The results of a campaign: every metric at every grid point, and paired differences."""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.simulation.exact_simulation import DIVERGED, OK, TOO_MANY_EVENTS, UNDECIDED
from cosim.studies.campaign.campaign_file import Campaign, label_of
from cosim.studies.campaign.campaign_grid import Point
from cosim.studies.campaign.chunk_store import Store
from cosim.studies.campaign.metrics import (
    CONFIDENCE,
    OF_THRESHOLD,
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
    """How often a burst was longer than ``mansd``; None if the network enforces the guarantee."""


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
        }


def summarise(campaign: Campaign, store: Store) -> CampaignSummary:
    """Estimate all metrics; the runs of a few grid points are in memory."""
    results = [_point_result(point, store) for point in store.points]
    return CampaignSummary(campaign, store.draws, results, list(_comparisons(campaign, store)))


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
                    and (name != OF_THRESHOLD or point.error_scale == reference.error_scale)
                }
                yield ComparedResult(point, reference, differences)
