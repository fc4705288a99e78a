"""The claims of a campaign, each with its verdict from the draws."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from cosim.studies.campaign.campaign_file import Campaign, Claim, Term, label_of
from cosim.studies.campaign.campaign_grid import Point
from cosim.studies.campaign.metrics import METRICS, Metric
from noack.core.linear_systems import Vector
from noack.core.number_format import number

CONFIRMED_FROM, PARTLY_FROM = 0.95, 0.5
_POINTS_AT_ONCE = 4
"""Number of grid points whose runs are in memory."""
Values = Callable[[Point], Mapping[Metric, Vector]]
"""Returns the metrics of all draws at a grid point, (draws,) each."""


class JudgedClaim(NamedTuple):
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
        where = (
            f"in {share_text(self.share)} of the draws{'' if self.least == self.share else least}"
        )
        return f"{where}; medians: {self.medians}"


def share_text(share: float) -> str:
    """Return a share in percent; only exactly all or none is written as 100 % or 0 %."""
    text = f"{100 * share:.0f}"
    rounded = text in ("0", "100") and share not in (0.0, 1.0)
    return f"{100 * share:.1f} %" if rounded else f"{text} %"


def judge_claims(
    campaign: Campaign, points: Sequence[Point], values: Values
) -> Iterator[JudgedClaim]:
    """Yield the claims of a campaign with their verdicts."""
    by_number = {point.number: point for point in points}
    cached = lru_cache(_POINTS_AT_ONCE)(lambda number: values(by_number[number]))
    at = {axis: {label_of(value) for value in given} for axis, given in campaign.claims_at.items()}
    for claim in campaign.claims:
        named = {axis: {label_of(value)} for axis, value in claim.where.items()}
        groups: dict[str, list[Point]] = {}
        for point in points:
            allowed = (
                at | named | ({} if claim.axis is None else {claim.axis: point.labels.values()})
            )
            if all(point.labels[axis] in known for axis, known in allowed.items()):
                rest = (
                    f"{axis} {label}" for axis, label in point.labels.items()
                    if axis != claim.axis and axis not in named
                )  # fmt: skip
                groups.setdefault(", ".join(rest), []).append(point)
        yield _judged(claim, groups, lambda point: cached(point.number))


def _judged(claim: Claim, groups: dict[str, list[Point]], values: Values) -> JudgedClaim:
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
                + number(float(middle)).replace("inf", "∞")
                for term, middle in zip((smaller, larger), middles, strict=True) if term.metric
            ]  # fmt: skip
        shares[name] = float(np.mean(np.logical_and.reduce(np.broadcast_arrays(*holds))))
        medians = medians or ", ".join(dict.fromkeys(texts))
    least_at = min(shares, key=shares.__getitem__)
    first = next(iter(shares.values()))
    return JudgedClaim(claim.says, claim.source, first, shares[least_at], least_at, medians)


def _side(term: Term, claim: Claim, group: Sequence[Point], values: Values) -> Vector:
    if term.metric is None:
        return np.array([term.number])
    (point,) = (p for p in group if term.label is None or p.labels[claim.axis or ""] == term.label)
    # A metric that the grid point does not have fulfils no condition.
    return values(point).get(term.metric, np.array([np.nan]))
