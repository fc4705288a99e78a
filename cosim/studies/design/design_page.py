"""The output of a design: one page (HTML) with figure and tables, and a table for a terminal.

A design is of a trigger (:class:`~cosim.studies.design.design_search.DesignResult`) or of a loop
for a network (:class:`DesignOutcome`). :func:`periodic_outcome` has the outcome of a search for
time-triggered loops.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console

from cosim.analysis.margin_search import stability_document
from cosim.output.figures import palette
from cosim.output.figures.figure_description import (
    MARKERS,
    Axis,
    FigureDescription,
    Item,
    Line,
    Marks,
    Panel,
    Rule,
    one_panel,
    plain,
    series_colour,
)
from cosim.output.figures.figure_files import save_figures
from cosim.output.figures.figure_format import FigureFiles
from cosim.output.page_kit import templates
from cosim.output.result_tables import ResultTable, terminal_table
from cosim.studies.design.design_search import WORDS, DesignResult, certified, designed_name
from cosim.studies.design.network_search import CertifiedLoop, NetworkSearch, Requirement
from noack.core.clock import NS_PER_S
from noack.core.file_access import write_whole
from noack.core.number_format import NONE, at_least, at_most, plus_minus
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import dumps, toml_text
from noack.settings.section import Rows

_CAPTION = (
    "Mean number of transmissions and quantile of the settling times of each candidate, all on the "
    "same draws. Candidates that settle too rarely to have a quantile are left out. The star is "
    "the chosen candidate on new draws."
)
_FRONT_CAPTION = "The trade-off curve; intervals have 95 % confidence, not corrected for the selection"
_GROWTH_CAPTION = (
    "Growth of the worst loss pattern found, per period: a lower bound, quickly computed. Below 1 "
    "every pattern may be stable; the marks are where this is proven."
)
_MOST_REQUIREMENTS = 60
"""Largest number of requirements in the figure of the growth."""
_HEIGHT_IN = 3.8
_MOST_ROWS = 20
HEADINGS = ("transmissions", "settling time", "α [1/s]", "β", "weight", "gain")
_LOOP_HEADINGS = ("", "given", "designed")
_HOLD_HEADINGS = ("between updates", "no destabilising pattern found for")
_HOLD_CAPTION = "best loop tried with each hold strategy (proven is only what the designed loop tolerates)"


def _write(
    path: Path, figure: FigureDescription, figure_files: FigureFiles | None, **content: object
) -> list[Path]:
    template = templates(Path(__file__).parent).get_template("design.html.jinja")
    html = template.render(figure=figure, **content)
    return [write_whole(path, html), *save_figures([figure], path, figure_files)]


def write_page(result: DesignResult, path: Path, figure_files: FigureFiles | None = None) -> list[Path]:
    """Write page and figure; return the files. All text except the figure is escaped.

    Raises:
        MachineError: they cannot be written.
    """
    limits, bounds = result.limits, result.bounds or {}
    return _write(
        path,
        trade_off(result),
        figure_files,
        title=result.name,
        kind="design",
        subtitle=f"{len(result.trials):,} candidates, {result.fresh.draws:,} draws, seed {result.seed}",
        verdict=result.verdict(),
        tone="good" if result.confirmed else "doubt" if result.feasible else "bad",
        notes=[
            f"required: {100 * limits.quantile:g} % of draws settle to {limits.settle:g} ‖x(0)‖ "
            f"within {limits.settling_s:g} s",
            *(f"required: {WORDS[name]} ≤ {limit:g}, certified" for name, limit in limits.bounds.items()),
            *(f"certified {result.conditions}: {certified(*bound)}" for bound in bounds.items()),
        ],
        heading="Trade-off",
        tables=[(_FRONT_CAPTION, HEADINGS, rows(result), 0)],
        scenario_toml=dumps(result.scenario),
    )


def trade_off(result: DesignResult) -> FigureDescription:
    """Describe all tried candidates, the trade-off curve, the limit and the chosen candidate."""
    items: list[Item] = []
    for i, family in enumerate(result.space.families):
        family_measures = [t.measured for t in result.trials if t.candidate.family == i]
        family_measures = [m for m in family_measures if np.isfinite(m.settling_s)]
        items.append(
            Marks(
                x=np.array([m.transmissions for m in family_measures]),
                y=np.array([m.settling_s for m in family_measures]),
                label=plain(f"W {family.name}", 24),
                colour=series_colour(i),
                marker=MARKERS[i % len(MARKERS)],
                size=3.5,
                opacity=0.5,
                reduced=False,
            )
        )
    front, best = [trial.measured for trial in result.front], result.fresh
    high_s = best.settling_high_s if np.isfinite(best.settling_high_s) else best.settling_s
    items += [
        Line(x=np.array([m.transmissions for m in front]),
             y=np.array([m.settling_s for m in front]), label="trade-off", steps="post",
             colour=palette.NETWORK, width=1.4),
        Rule(at=result.limits.settling_s, colour=palette.CERTIFIED, label="limit"),
        Marks(x=np.array([best.transmissions]), y=np.array([best.settling_s]), marker="*",
              size=12, colour=palette.LOST,
              label="the choice" if result.feasible else "the closest",
              x_error=np.array([best.halfwidth]),
              y_error=np.array([[best.settling_s - best.settling_low_s],
                                [high_s - best.settling_s]])),
    ]  # fmt: skip
    settles = any(np.isfinite(trial.measured.settling_s) for trial in result.trials)
    panel = Panel(
        items=items,
        x=Axis(label="transmissions (mean)", logarithmic=settles),
        y=Axis(label=f"settling time, {100 * result.limits.quantile:g} % quantile [s]"),
    )
    return one_panel("trade-off", panel, _HEIGHT_IN).captioned(_CAPTION)


def rows(result: DesignResult) -> list[tuple[str, ...]]:
    """Return the rows of the trade-off curve."""
    return [
        (
            plus_minus(trial.measured.transmissions, trial.measured.halfwidth),
            trial.measured.settling,
            f"{trial.candidate.alpha_per_s:.4g}",
            f"{trial.candidate.beta:.4g}",
            result.space.families[trial.candidate.family].weight,
            result.space.families[trial.candidate.family].gain,
        )
        for trial in result.front
    ]


def print_trigger_design(console: Console, result: DesignResult) -> None:
    """Print the trade-off curve, thinned if it is long, and the verdict."""
    all_rows = rows(result)
    step = -(-len(all_rows) // _MOST_ROWS)
    table_rows = [row for i, row in enumerate(all_rows) if i % step == 0 or result.front[i] is result.best]
    title = f"{result.name}: trade-off, {len(table_rows)} of {len(all_rows)} rows"
    if all_rows:
        words = range(len(HEADINGS) - 2, len(HEADINGS))
        console.print(terminal_table(ResultTable("design", title, HEADINGS, table_rows), left=words))
    lines = []
    if result.feasible:
        lines = [
            result.verdict(),
            f"chosen among {len(result.trials):,} candidates on {result.best.measured.draws:,} "
            f"draws; the numbers are from {result.fresh.draws:,} other draws",
        ]
    if result.bounds:
        bounds = [certified(name, value) for name, value in result.bounds.items()]
        lines.append(f"certified {result.conditions}: {', '.join(bounds)}")
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)


class LoopResult(NamedTuple):
    """What is found of a loop."""

    reach: str
    """The most that it is certified for."""
    cells: dict[str, str]
    """By heading."""
    document: dict[str, object]
    """As JSON."""


@dataclass(frozen=True)
class DesignOutcome:
    """The given loop and the best one found, as results."""

    name: str
    """Name of the given scenario."""
    claim: str
    """What is certified of both loops."""
    given: LoopResult
    best: LoopResult
    notes: Sequence[str]
    """What the reader should know of the search."""
    scenario: Scenario
    """The scenario of the best loop, with the guarantee that it is certified for."""
    is_certified: bool
    """Whether the best loop is certified for anything."""
    is_better: bool
    """Whether it is another loop than the given one."""
    document: dict[str, object]
    """The limits and the size of the search, as JSON."""
    figure: FigureDescription
    by_hold: tuple[tuple[str, str], ...] = ()
    """Hold strategies that were tried, each with the most for which no pattern destabilises its best
    loop, as far as was searched."""

    @property
    def verdict(self) -> str:
        """The result as a sentence."""
        if not self.is_better:
            return f"{self.best.reach} for the given loop; no better one was found"
        return f"{self.claim}: {self.given.reach} before, {self.best.reach} after"

    @property
    def lines(self) -> str:
        """What to change in the scenario, as TOML."""
        document = self.scenario.model_dump(mode="json", exclude_none=True)
        keys = {
            "model": ("gain",),
            "network": ("mansd", "constraints"),
            "trigger": ("policy", "period_s", "alpha_per_s", "beta"),
        }
        if "update_timeout_s" in document["controller"]:
            keys["controller"] = ("update_timeout_s", "timeout_input")
        tables = {
            table: {key: document[table][key] for key in table_keys if document[table].get(key, []) != []}
            for table, table_keys in keys.items()
        }
        return toml_text({"mode": document["mode"], **tables})

    @property
    def rows(self) -> list[tuple[str, str, str]]:
        """The comparison of both loops."""
        return [(heading, cell, self.best.cells[heading]) for heading, cell in self.given.cells.items()]

    def to_json(self) -> dict[str, object]:
        """Return the result and the lines for the scenario."""
        return {
            "scenario": self.name,
            "verdict": self.verdict,
            "lines": self.lines,
            **self.document,
            "given": self.given.document,
            "best": self.best.document,
        }

    def scenario_toml(self) -> str:
        """Return the scenario of the best loop as TOML, under a new name."""
        name = designed_name(self.name)
        description = f"{self.name}{', designed' * self.is_better}: {self.verdict}."
        return dumps(self.scenario.model_copy(update={"name": name, "description": description}))


def gain_text(K: Rows) -> str:
    """Return a gain as lines of text."""
    return "\n".join(" ".join(f"{entry:.6g}" for entry in row) for row in K)


def figure_of(name: str, panel: Panel, caption: str) -> FigureDescription:
    """Return the figure of an outcome."""
    return one_panel(name, panel, _HEIGHT_IN).captioned(caption)


def write_outcome(outcome: DesignOutcome, path: Path, figure_files: FigureFiles | None = None) -> list[Path]:
    """Write page and figure; return the files.

    Raises:
        MachineError: they cannot be written.
    """
    by_hold = (_HOLD_CAPTION, _HOLD_HEADINGS, outcome.by_hold, 1)
    return _write(
        path,
        outcome.figure,
        figure_files,
        title=outcome.name,
        kind="design for a network",
        subtitle="",
        verdict=outcome.verdict,
        tone="good" if outcome.is_better else "doubt",
        notes=outcome.notes,
        heading="Worst losses",
        tables=[("Both loops", _LOOP_HEADINGS, outcome.rows, 1), *[by_hold] * (len(outcome.by_hold) > 1)],
        scenario_toml=outcome.scenario_toml(),
    )


def print_loop_design(console: Console, outcome: DesignOutcome) -> None:
    """Print the comparison, the verdict, and the lines for the scenario."""
    title = f"{outcome.name}: loops under the worst losses"
    table = ResultTable("design", title, _LOOP_HEADINGS, outcome.rows)
    console.print(terminal_table(table, left=range(3)))
    if len(outcome.by_hold) > 1:
        table = ResultTable("holds", _HOLD_CAPTION, _HOLD_HEADINGS, outcome.by_hold)
        console.print(terminal_table(table))
    lines = [outcome.verdict, *outcome.notes]
    if outcome.is_certified:
        lines.append(f"for the scenario:\n{outcome.lines.rstrip()}")
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)


def periodic_outcome(search: NetworkSearch, original: CertifiedLoop, best: CertifiedLoop) -> DesignOutcome:
    """Return what is shown of a search."""
    return DesignOutcome(
        search.scenario.name,
        "proven stable for every loss pattern",
        _loop_result(search, original, is_excluded=not search.keeps_given_hold),
        _loop_result(search, best),
        list(_network_notes(search, original, best)),
        search.scenario_of(best.candidate, best.level),
        best.level >= 0,
        best.candidate != original.candidate,
        {
            "goal": search.request.goal,
            "window": search.request.window,
            "cost_limit": search.limit,
            "tried": search.tried,
            "examined": search.examined,
            "highest_by_hold": dict(search.by_hold()),
        },
        _growth_figure(search, original, best),
        tuple(search.by_hold()),
    )


def _loop_result(search: NetworkSearch, loop: CertifiedLoop, *, is_excluded: bool = False) -> LoopResult:
    requirements, (hold, K), proven = search.requirements, loop.candidate, loop.stability
    requirement = requirements[max(loop.level, 0)]
    sent = search.scenario.timing.measurement_period_ns / requirement.period_ns
    reach = requirement.name + (", the most examined" * (loop.level == len(requirements) - 1))
    if loop.level < 0:
        reach = "nothing proven"
    growth = (
        f"{at_least(proven.lower, decimals=5)} to {at_most(proven.upper, decimals=5)}" if proven else NONE
    )
    cells = {
        "proven stable for": reach,
        "growth per period there": growth,
        "the next one": _next_requirement_text(requirements, loop),
        "cost without losses": f"{loop.cost:.4g}",
        "share of measurements sent": f"{100 * sent:.3g} %",
        "between updates": hold.text + " (not in --holds)" * is_excluded,
        "K": gain_text(K),
    }
    certified = None if loop.level < 0 else requirement.number
    document: dict[str, object] = {"certified": certified, "cost": loop.cost, "transmitted": sent}
    document |= {"mode": hold.mode, "hold": hold.text, "K": K}
    for name, stability in (("stability", proven), ("beyond", loop.beyond)):
        document[name] = stability and stability_document(stability)
    return LoopResult(reach, cells, document)


def _network_notes(search: NetworkSearch, original: CertifiedLoop, best: CertifiedLoop) -> Iterator[str]:
    """Yield what the reader should know of a search."""
    limit = f"{search.limit:.4g}" if math.isfinite(search.limit) else "any size"
    yield (
        f"the best of {search.tried:,} loops tried, with a cost of at most {limit}; what it "
        "tolerates is proven, that it is the best is not"
    )
    if best.level < original.level:
        hold = original.candidate.hold.text
        yield f"the given loop tolerates more than the designed one; --holds excludes its strategy, {hold}"
    period_s = search.period_ns / NS_PER_S
    if search.request.period_s is not None and round(search.request.period_s * NS_PER_S) != search.period_ns:
        yield f"--period {search.request.period_s:g}: updates are sent at measurements, every {period_s:g} s"


def _next_requirement_text(requirements: Sequence[Requirement], loop: CertifiedLoop) -> str:
    if loop.level + 1 == len(requirements):
        return "not examined"
    if loop.beyond is None:
        return f"{requirements[loop.level + 1].name}: costs too much"
    destabilised = loop.beyond.verdict == "destabilised"
    result = f"{loop.beyond.text} destabilises" if destabilised else "undecided"
    return f"{requirements[loop.level + 1].name}: {result}"


def _growth_figure(search: NetworkSearch, original: CertifiedLoop, best: CertifiedLoop) -> FigureDescription:
    """Describe the growth of both loops over the requirements."""
    requirements, request = search.requirements, search.request
    top = min(max(best.level, original.level) + 4, len(requirements))
    levels = np.unique(np.linspace(0, top - 1, min(top, _MOST_REQUIREMENTS)).astype(int))
    numbers = np.array([requirement.number for requirement in requirements])
    items: list[Item] = [Rule(at=1.0, colour=palette.CERTIFIED, label="stable below")]
    for loop, label, colour in ((original, "given", palette.NETWORK), (best, "designed", palette.LOST)):
        growth = np.exp(np.minimum([search.growth(loop.candidate, int(i)) for i in levels], 1.1))
        items.append(Line(x=numbers[levels], y=growth, colour=colour, label=label, marker="o"))
        if loop.stability is not None:
            x, y = numbers[[loop.level]], np.array([loop.stability.upper])
            mark_label = f"{label}: proven"
            items.append(Marks(x=x, y=y, colour=colour, marker="*", size=12, label=mark_label))
    x_label = "M" if request.window is None else f"losses in {request.window} updates"
    if request.goal == "transmissions":
        x_label = "time between updates [s]"
    x_axis = Axis(label=x_label, whole=request.goal == "network")
    panel = Panel(items=items, x=x_axis, y=Axis(label="growth per period"))
    return figure_of("growth", panel, _GROWTH_CAPTION)
