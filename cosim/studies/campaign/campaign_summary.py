"""The results of a campaign: every metric at every grid point, and paired differences."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from cosim.simulation.exact_simulation import DIVERGED, OK, TOO_MANY_EVENTS, UNDECIDED
from cosim.studies.campaign.campaign_claims import JudgedClaim, judge_claims
from cosim.studies.campaign.campaign_file import Campaign, label_of
from cosim.studies.campaign.campaign_grid import Point
from cosim.studies.campaign.chunk_store import Store
from cosim.studies.campaign.metrics import (
    CONFIDENCE,
    BurstFrequency,
    Estimate,
    Metric,
    PairedDifference,
    burst_frequency,
    difference,
    estimate,
    measured,
)
from noack.core.linear_systems import Vector

_ROUNDING = 1e-9
_ENDED = {
    OK: "finished", DIVERGED: "diverged", TOO_MANY_EVENTS: "too_many_events",
    UNDECIDED: "undecided",
}  # fmt: skip


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
    found: Sequence[GridPointResult]
    compared: Sequence[ComparedResult]
    claims: Sequence[JudgedClaim] = ()

    @property
    def breaches(self) -> int:
        """Number of runs in which a certified bound is exceeded."""
        return sum(found.breaches for found in self.found)

    def document(self) -> dict[str, Any]:
        """The content of ``summary.json``."""
        return {
            "name": self.campaign.name,
            "draws": self.draws,
            "confidence": CONFIDENCE,
            "breaches": self.breaches,
            "points": [
                {
                    "axes": dict(found.point.labels),
                    "ended": dict(found.ended),
                    "certified_error": found.point.certified_error,
                    "bursts": None if found.bursts is None else found.bursts._asdict(),
                    "metrics": {name: e._asdict() for name, e in found.estimates.items()},
                }
                for found in self.found
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
                {**claim._asdict(), "verdict": claim.verdict, "reason": claim.reason}
                for claim in self.claims
            ],
        }


def summarise(campaign: Campaign, store: Store) -> CampaignSummary:
    """Estimate all metrics and judge the claims; the runs of a few grid points are in memory."""
    found = [_found(point, store) for point in store.points]

    def values(point: Point) -> Mapping[Metric, Vector]:
        return runs_at(point, store)[0]

    claims = list(judge_claims(campaign, store.points, values))
    return CampaignSummary(campaign, store.draws, found, list(_compared(campaign, store)), claims)


def runs_at(point: Point, store: Store) -> tuple[dict[Metric, Vector], Vector]:
    """Return all metrics of the runs at a grid point, and the status of each run."""
    columns = store.columns(point.number, store.row_type.names or ())
    return measured(columns, point.certified_error), columns["status"]


def _found(point: Point, store: Store) -> GridPointResult:
    metrics, status = runs_at(point, store)
    used = metrics.get("certificate_used", np.zeros(0))
    return GridPointResult(
        point,
        {how: int((status == code).sum()) for code, how in _ENDED.items() if code in status},
        {name: estimate(values) for name, values in metrics.items()},
        int((used[np.isfinite(used)] > 1 + _ROUNDING).sum()),
        burst_frequency(point.scenario, metrics),
    )


def _compared(campaign: Campaign, store: Store) -> Iterator[ComparedResult]:
    if campaign.compare is None:
        return
    axis, wanted = campaign.compare.axis, label_of(campaign.compare.reference)
    groups: dict[tuple[str, ...], list[Point]] = {}
    for point in store.points:
        others = tuple(label for name, label in point.labels.items() if name != axis)
        groups.setdefault(others, []).append(point)
    for group in groups.values():
        reference = next(point for point in group if point.labels[axis] == wanted)
        own, _ = runs_at(reference, store)
        for point in group:
            if point is not reference:
                differences = {
                    name: difference(values, own[name])
                    for name, values in runs_at(point, store)[0].items() if name in own
                }  # fmt: skip
                yield ComparedResult(point, reference, differences)
