"""The page of a campaign: one file of HTML with all its figures and tables."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import tomli_w
from markupsafe import Markup

from cosim.output.report.figure_files import inline
from cosim.output.report.report_page import templates
from cosim.studies.campaign.campaign_figures import Drawn
from cosim.studies.campaign.campaign_summary import CampaignSummary, ComparedResult, GridPointResult
from cosim.studies.campaign.draw_statistics import Estimate
from cosim.studies.campaign.metrics import METRICS, Metric
from noack.core.number_format import plus_minus

NONE = "–"


class SummaryRow(NamedTuple):
    """A row of a table of grid points."""

    labels: Sequence[str]
    cells: Sequence[str]


def page(summary: CampaignSummary, drawn: Sequence[Drawn], base: Mapping[str, Any]) -> str:
    """Return the page as HTML; all text except the figures is escaped.

    Args:
        summary: the results.
        drawn: the figures in order.
        base: content of the scenario of all runs.
    """
    campaign = summary.campaign
    content = campaign.model_dump(mode="json", exclude_none=True)
    return templates(Path(__file__).parent).get_template("campaign.html.jinja").render(
        title=campaign.name,
        description=campaign.description,
        subtitle=f"{len(summary.found):,} grid points, {summary.draws:,} draws at each, "
        f"seed {campaign.seed}",
        verdict=verdict(summary),
        tone="bad" if summary.breaches else "doubt" if any(unfinished(summary)) else "good",
        remarks=list(unfinished(summary)),
        figures=[
            (one.name, Markup(inline(one.figure, one.name, one.caption)), one.caption)
            for one in drawn
        ],
        axes=[axis.called for axis in campaign.axes],
        metrics=[METRICS[name].heading for name in campaign.metrics.shown],
        rows=[found_row(found, campaign.metrics.shown) for found in summary.found],
        reference=None if campaign.compare is None
        else f"{campaign.by_name[campaign.compare.axis].called} = {campaign.compare.reference}",
        differences=[_compared_row(one, campaign.metrics.shown) for one in summary.compared],
        campaign_toml=tomli_w.dumps(content, indent=2),
        scenario_toml=tomli_w.dumps(base, indent=2),
    )  # fmt: skip


def verdict(summary: CampaignSummary) -> str:
    """Return one sentence on all results."""
    runs = len(summary.found) * summary.draws
    certified = sum(found.point.certified_error is not None for found in summary.found)
    if summary.breaches:
        return f"{summary.breaches:,} of {runs:,} runs exceed a certified bound."
    if not certified:
        return (
            f"{runs:,} runs; no grid point has a certified bound "
            "(a hold, a floor and other policies have none)."
        )
    where = "all" if certified == len(summary.found) else f"{certified} of {len(summary.found)}"
    return f"{runs:,} runs; {where} grid points have a certified bound; none was exceeded."


def found_row(found: GridPointResult, metrics: Sequence[Metric]) -> SummaryRow:
    """Return a grid point's means with their intervals."""
    cells = [written(found.estimates[m]) if m in found.estimates else NONE for m in metrics]
    return SummaryRow(list(found.point.labels.values()), cells)


def compared_row(compared: ComparedResult, metrics: Sequence[Metric]) -> SummaryRow:
    """Return mean differences with their intervals."""
    found = [compared.differences.get(metric) for metric in metrics]
    cells = [written(d.estimate) if d and d.estimate.finite else NONE for d in found]
    return SummaryRow(list(compared.point.labels.values()), cells)


def _compared_row(compared: ComparedResult, metrics: Sequence[Metric]) -> SummaryRow:
    """Return mean differences, with the share of draws in which the metric is smaller."""
    labels, cells = compared_row(compared, metrics)
    shares = [
        compared.differences[m].smaller if m in compared.differences else None for m in metrics
    ]
    return SummaryRow(
        labels,
        [
            cell if share is None else f"{cell}, smaller in {100 * share:.3g} %"
            for cell, share in zip(cells, shares, strict=True)
        ],
    )


def written(estimate: Estimate) -> str:
    """Return mean ± half-width, with the share of finite runs if it is below 100 %."""
    if not estimate.finite:
        return "never"
    text = plus_minus(estimate.mean, estimate.halfwidth)
    if estimate.finite < estimate.draws:
        text += f" ({100 * estimate.finite / estimate.draws:.4g} % of runs)"
    return text


def unfinished(summary: CampaignSummary) -> Iterator[str]:
    """Return a note for each grid point at which a run did not reach the horizon."""
    for found in summary.found:
        others = {how: count for how, count in found.ended.items() if how != "finished"}
        if others:
            where = ", ".join(f"{axis} {label}" for axis, label in found.point.labels.items())
            counts = ", ".join(f"{n:,} {how.replace('_', ' ')}" for how, n in others.items())
            yield f"At {where} not all runs reached the horizon: {counts}"
