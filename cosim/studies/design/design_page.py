"""The page of a design: one HTML file with figure and tables, and the table for a terminal."""

from pathlib import Path

from markupsafe import Markup
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from cosim.output.report.figure_files import inline
from cosim.output.report.report_page import templates
from cosim.studies.design.design_figure import trade_off
from cosim.studies.design.design_result import WORDS, DesignResult, certified, seconds
from noack.config.scenario_file import dumps
from noack.core.number_format import plus_minus

_CAPTION = (
    "Mean number of transmissions and quantile of the settling times of each candidate, all on the "
    "same draws. Candidates that settle too rarely to have a quantile are left out. The star is "
    "the chosen candidate on new draws."
)
_MOST_ROWS = 20
HEADINGS = ("transmissions", "settling time", "α [1/s]", "β", "weight", "gain")


def page(found: DesignResult) -> str:
    """Return the page as HTML; all text except the figure is escaped."""
    limits, bounds = found.limits, found.bounds or {}
    lines = [
        f"{100 * limits.quantile:g} % of draws settle to {limits.settle:g} ‖x(0)‖ "
        f"within {limits.settling_s:g} s",
        *(f"{WORDS[name]} ≤ {limit:g}, certified" for name, limit in limits.bounds.items()),
    ]
    return templates(Path(__file__).parent).get_template("design.html.jinja").render(
        title=found.space.families[0].scenario.name,
        subtitle=f"{len(found.trials):,} candidates, {found.fresh.draws:,} draws, "
        f"seed {found.seed}",
        verdict=found.verdict(),
        tone="good" if found.confirmed else "doubt" if found.feasible else "bad",
        limits=lines,
        certified=[certified(name, value) for name, value in bounds.items()],
        conditions=found.conditions,
        figure=Markup(inline(trade_off(found), "trade-off", _CAPTION)),
        caption=_CAPTION,
        headings=HEADINGS,
        rows=rows(found),
        scenario_toml=dumps(found.scenario),
    )  # fmt: skip


def rows(found: DesignResult) -> list[tuple[str, ...]]:
    """Return the rows of the trade-off curve."""
    found_rows: list[tuple[str, ...]] = []
    for trial in found.front:
        family = found.space.families[trial.candidate.family]
        found_rows.append(
            (
                plus_minus(trial.measured.transmissions, trial.measured.halfwidth),
                seconds(trial.measured),
                f"{trial.candidate.alpha_per_s:.4g}",
                f"{trial.candidate.beta:.4g}",
                family.weight,
                family.gain,
            )
        )
    return found_rows


def print_found(console: Console, found: DesignResult) -> None:
    """Print the trade-off curve, thinned if it is long, and the verdict."""
    title = f"{found.space.families[0].scenario.name}: trade-off of transmissions and settling time"
    # The table must fit into 80 columns.
    table = Table(
        title=title, title_justify="left", box=SIMPLE_HEAD, collapse_padding=True, pad_edge=False
    )
    for heading in HEADINGS:
        words = heading in HEADINGS[-2:]
        table.add_column(heading, justify="left" if words else "right", no_wrap=True)
    every = rows(found)
    for row in every[:: -(-len(every) // _MOST_ROWS) or 1]:
        table.add_row(*row)
    if every:
        console.print(table)
    if found.feasible:
        console.print(found.verdict(), highlight=False, markup=False, soft_wrap=True)
        console.print(
            f"chosen among {len(found.trials):,} candidates on {found.best.measured.draws:,} "
            f"draws; the numbers are from {found.fresh.draws:,} other draws",
            highlight=False,
            soft_wrap=True,
        )
    bounds = [certified(name, value) for name, value in (found.bounds or {}).items()]
    if bounds:
        text = f"certified {found.conditions}: {', '.join(bounds)}"
        console.print(text, highlight=False, soft_wrap=True)
