"""The output of a capacity study: page, figures, JSON, and a table for a terminal."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic_core import to_json
from rich.console import Console

from cosim.output.figures import palette
from cosim.output.figures.figure_description import FigureDescription, Item, Marks, Rule, series_colour
from cosim.output.figures.figure_files import save_figure
from cosim.output.figures.figure_format import SCREEN_IN, FigureFiles, FigureFormat
from cosim.output.page_kit import templates
from cosim.output.result_tables import ResultTable, terminal_table
from cosim.studies.campaign.campaign_figures import curve_figure
from cosim.studies.campaign.campaign_summary import CampaignSummary
from cosim.studies.campaign.metrics import METRICS
from cosim.studies.capacity.capacity_plan import COMMON, DISTURBANCE, LOOPS, OWN, POLICY, CapacityPlan
from cosim.studies.capacity.capacity_result import (
    COST_FACTOR,
    LIMITS,
    MOST_LATE_SHARE,
    Capacity,
    Limit,
    LivePoint,
    PolicyCapacity,
)
from cosim.studies.capacity.loop_kinds import PERIODIC
from noack.core.file_access import write_whole
from noack.core.number_format import number
from noack.scenario.link_load import update_delay

PAGE, RESULTS = "capacity.html", "capacity.json"
_SENTENCES = {
    "guarantee": "a loop used up its guarantee: M − 1 consecutive losses, one in the full queue",
    "deadline": f"more than {100 * MOST_LATE_SHARE:g} % of the updates were late",
    "cost": f"the mean cost of the loops, or of one kind of them, was at least {COST_FACTOR:g} "
    "times that of loops that have the link for themselves",
}
_FINITE_FROM = 6
"""Number of draws from which on the interval of a median is finite."""


class CapacityResult(NamedTuple):
    """The results of a capacity study."""

    plan: CapacityPlan
    summary: CampaignSummary
    capacities: Sequence[PolicyCapacity]
    live: Sequence[LivePoint]

    def to_json(self) -> dict[str, object]:
        """Return the results for JSON."""
        plan = self.plan
        return {
            "scenario": plan.scenario.name,
            "rate_bps": plan.rate_bps,
            "delay_bounds_s": delay_bounds_s(self),
            "deadline_s": plan.deadline_s,
            "periodic_loops_by_rate": plan.periodic_loops,
            "mixture": [
                {"name": kind.name, "count": kind.loops, "period_s": kind.period_s} for kind in plan.kinds
            ],
            "loops": list(plan.counts),
            "draws": plan.draws,
            "disturbance": plan.amplitude,
            "seed": plan.seed,
            "capacities": [capacity.to_json(plan) for capacity in self.capacities],
            "comparisons": list(comparison_sentences(self)),
            "points": self.summary.to_json()["points"],
            "live": [point.to_json() for point in self.live],
        }


def write(result: CapacityResult, folder: Path, figure_files: FigureFiles | None = None) -> list[Path]:
    """Write page, JSON and figures; return their paths.

    Raises:
        MachineError: they cannot be written.
    """
    document = to_json(result.to_json(), indent=1, inf_nan_mode="null")
    paths = [write_whole(folder / PAGE, page(result)), write_whole(folder / RESULTS, document + b"\n")]
    files = figure_files or FigureFiles(FigureFormat.SVG, SCREEN_IN)
    for figure in figures(result):
        paths.append(folder / f"{figure.name}.{files.kind}")
        save_figure(figure, paths[-1], files.width_in)
    return paths


def page(result: CapacityResult) -> str:
    """Return the page as HTML; all text except the figures is escaped."""
    plan = result.plan
    return (
        templates(Path(__file__).parent)
        .get_template("capacity.html.jinja")
        .render(
            title=plan.scenario.name,
            subtitle=f"{plan.link}, {plan.draws:,} draws at each number of loops, seed {plan.seed}",
            verdict=f"{rate_sentence(plan).capitalize()}.",
            comparisons=[
                *comparison_sentences(result),
                *mixture_sentences(result),
                *waiting_sentences(result),
                *caveat_sentences(plan),
            ],
            counts=", ".join(map(str, plan.counts)),
            deadline=f"{plan.deadline_s:g} s",
            from_s=f"{plan.counted_from_s:g} s",
            limits=[(name, _SENTENCES[name]) for name in LIMITS],
            rows=list(rows(result)),
            headings=HEADINGS,
            figures=list(figures(result)),
            live=[live_row(point) for point in result.live],
        )
    )


HEADINGS = ("policy", "disturbance", "loops carried", "limited by", *LIMITS)


def rows(result: CapacityResult) -> Iterator[tuple[str, ...]]:
    """Yield the rows of the table of capacities."""
    last = result.plan.counts[-1]
    for case in result.capacities:
        limits = [_limit_text(case.limits[limit], last) for limit in LIMITS]
        any_limit = _limit_text(case.any_limit, last)
        yield case.policy, case.disturbance, any_limit, case.limited_by or "–", *limits


def rate_sentence(plan: CapacityPlan) -> str:
    """Say how many periodic loops the rate carries, or the slots."""
    carrier = "the slots carry" if plan.rate_bps is None else "the rate carries"
    if plan.is_one_kind:
        (kind,) = plan.kinds
        return f"{carrier} {plan.periodic_loops:.1f} loops, periodic every {kind.period_s:g} s"
    periods = ", ".join(f"{kind.name} every {kind.period_s:g} s" for kind in plan.kinds)
    factor = plan.factor(plan.periodic_loops)
    return f"{carrier} {factor:.2f} × the given mixture, {plan.periodic_loops:.1f} loops, periodic: {periods}"


def mixture_sentences(result: CapacityResult) -> Iterator[str]:
    """Yield the median capacities as multiples of the mixture that the scenario has."""
    plan = result.plan
    for capacity in () if plan.is_one_kind else result.capacities:
        median, prefix = capacity.any_limit.median, ""
        if math.isinf(median):
            median, prefix = plan.counts[-1], "at least "
        text = f"{prefix}{plan.factor(median):g} × the given mixture"
        if median:
            text += f" ({_listed(plan.composition(median))})"
        else:
            text += f"; {_listed(plan.composition(plan.counts[0]))} already reach a limit"
        yield f"{capacity.policy}, disturbance {capacity.disturbance}: {text}"


def delay_bounds_s(result: CapacityResult) -> dict[str, list[float]]:
    """Return the bound of an update's delay for each number of loops, by policy; infinite: none."""
    scenarios = {
        (entry.point.labels[POLICY], entry.point.labels[LOOPS]): entry.point.scenario
        for entry in result.summary.results
    }
    counts = [*map(str, result.plan.counts)]
    return {
        policy: [update_delay(scenarios[policy, count]).largest_s for count in counts]
        for policy in result.plan.policies
    }


def waiting_sentences(result: CapacityResult) -> Iterator[str]:
    """Yield the bounds of each policy that has one."""
    for policy, bounds_s in delay_bounds_s(result).items():
        if any(map(math.isfinite, bounds_s)):
            times_text = ", ".join(f"{t_s:.4g}" if math.isfinite(t_s) else "∞" for t_s in bounds_s)
            counts = ", ".join(map(str, result.plan.counts))
            yield f"{policy}: updates of {counts} loops wait at most {times_text} s in virtual time"


def caveat_sentences(plan: CapacityPlan) -> Iterator[str]:
    """Yield what a thorough study has, and this one has not."""
    if plan.draws < _FINITE_FROM:
        number = "one draw" if plan.draws == 1 else f"{plan.draws} draws"
        yield (
            f"{number}: the intervals are infinite, which decides no comparison; {_FINITE_FROM} "
            "draws, or --thorough, make them finite"
        )
    if not plan.amplitude:
        yield "no runs with a common disturbance, after which event-triggered loops carry fewer"


def _listed(composition: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in composition.items())


def comparison_sentences(result: CapacityResult) -> Iterator[str]:
    """Yield for each event-triggered policy whether it carries more loops than the periodic one."""
    limits = {(capacity.policy, capacity.disturbance): capacity.any_limit for capacity in result.capacities}
    last = result.plan.counts[-1]
    for (policy, disturbance), limit in limits.items():
        periodic_limit = limits[PERIODIC, disturbance]
        if policy == PERIODIC:
            continue
        outcome = "undecided, the intervals overlap"
        if limit.low > periodic_limit.high or (limit.low == math.inf > periodic_limit.high):
            outcome = "wins"
        elif limit.high < periodic_limit.low:
            outcome = "loses"
        setting = "with a common disturbance" if disturbance == COMMON else "as in the scenario"
        yield (
            f"{policy} against {PERIODIC}, {setting}: {outcome} ({_limit_text(limit, last)} and "
            f"{_limit_text(periodic_limit, last)} loops)"
        )


def figures(result: CapacityResult) -> Iterator[FigureDescription]:
    """Describe the metric of each limit over the number of loops."""
    for disturbance in dict.fromkeys(capacity.disturbance for capacity in result.capacities):
        for limit, metric in LIMITS.items():
            yield replace(
                _figure(result, limit, disturbance),
                name=f"{limit}-{'common' if disturbance == COMMON else 'own'}",
                caption=f"{METRICS[metric].title.capitalize()} over the number of loops; "
                f"disturbance: {disturbance}. Means with 95 % confidence intervals"
                + ("; crosses are live runs." if _is_live(result, disturbance) else "."),
            )


def _figure(result: CapacityResult, limit: Limit, disturbance: str) -> FigureDescription:
    counts, metric = result.plan.counts, LIMITS[limit]
    results = {
        (entry.point.labels[POLICY], entry.point.labels[LOOPS]): entry.estimates[metric]
        for entry in result.summary.results
        if entry.point.labels.get(DISTURBANCE, OWN) == disturbance
    }
    policies = list(result.plan.policies)
    series = {name: [results[name, str(count)] for count in counts] for name in policies}
    figure = curve_figure(
        np.array(counts, dtype=np.float64), [*map(str, counts)], series, "number of loops", metric
    )
    ((panel,),) = (row.panels for row in figure.rows)
    items: list[Item] = [
        Rule(at=result.plan.periodic_loops, colour=palette.CERTIFIED, vertical=True, order=0),
        *panel.items,
    ]
    if _is_live(result, disturbance):
        items += [
            Marks(
                x=np.array([float(point.loops)]),
                y=np.array([point.values[metric]]),
                marker="x",
                size=9,
                stroke=2.2,
                colour=series_colour(policies.index(point.policy)),
            )
            for point in result.live
        ]
    y = panel.y if limit == "cost" else replace(panel.y, ends=(-0.02, 1.02))
    return replace(figure, rows=[replace(figure.rows[0], panels=[replace(panel, items=items, y=y)])])


def _is_live(result: CapacityResult, disturbance: str) -> bool:
    return bool(result.live) and disturbance == OWN


def live_row(point: LivePoint) -> tuple[str, ...]:
    """Return the row of a live run: each metric with the interval of the simulation."""
    cells = [
        f"{number(point.values[metric])} [{number(low)}, {number(high)}]"
        for metric, (low, high) in point.simulated.items()
    ]
    verdict = "agrees" if not point.outside else f"differs: {', '.join(point.outside)}"
    if point.status:
        verdict = f"failed: {point.reason}"
    return (point.policy, str(point.loops), *cells, str(point.unintended_losses), verdict)


def _limit_text(capacity: Capacity, last: int) -> str:
    def text(count: float) -> str:
        return f"≥ {last}" if math.isinf(count) else f"{count:g}"

    return f"{text(capacity.median)} [{text(capacity.low)}, {text(capacity.high)}]"


def print_result(console: Console, result: CapacityResult) -> None:
    """Print the capacities, the comparisons and the live runs."""
    plan, columns = result.plan, slice(4)  # the table must fit into 80 columns
    title = f"{plan.scenario.name}: loops on {plan.link}"
    table_rows = [row[columns] for row in rows(result)]
    table = ResultTable("capacity", title, HEADINGS[columns], table_rows)
    console.print(terminal_table(table, left=range(4)))
    lines = [
        f"loops carried: median [95 % interval] of {', '.join(map(str, plan.counts))} loops",
        rate_sentence(plan),
        *mixture_sentences(result),
        *comparison_sentences(result),
        *waiting_sentences(result),
        *caveat_sentences(plan),
        *(f"live: {point.policy}, {point.loops} loops: {live_row(point)[-1]}" for point in result.live),
    ]
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)
