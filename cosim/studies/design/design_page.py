"""The output of a design: one page (HTML) with figure and tables, and a table for a terminal."""

from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from cosim.output import palette
from cosim.output.figure_format import FigureFiles
from cosim.output.report.axes import finish, legend, logarithmic, plain, single
from cosim.output.report.figure_files import inline, save_figures
from cosim.output.report.figure_style import printed, styled
from cosim.output.report.report_page import templates
from cosim.studies.design.candidates import WORDS, DesignResult, certified, seconds
from noack.config.scenario_file import dumps
from noack.core.file_access import write_whole
from noack.core.number_format import plus_minus

_CAPTION = (
    "Mean number of transmissions and quantile of the settling times of each candidate, all on the "
    "same draws. Candidates that settle too rarely to have a quantile are left out. The star is "
    "the chosen candidate on new draws."
)
_HEIGHT_IN = 3.8
_MARKERS = "os^Dv<>PX"
_MOST_ROWS = 20
HEADINGS = ("transmissions", "settling time", "α [1/s]", "β", "weight", "gain")


def write_page(
    found: DesignResult, path: Path, figure_files: FigureFiles | None = None
) -> list[Path]:
    """Write page and figure; return the files.

    Raises:
        MachineError: they cannot be written.
    """
    figures = ((name, draw(found)) for name, draw in (("trade-off", trade_off),))
    return [write_whole(path, page(found)), *save_figures(figures, path, figure_files)]


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


@styled
def trade_off(found: DesignResult) -> Figure:
    """Draw all tried candidates, the trade-off curve, the limit and the chosen candidate."""
    names = [f"W {family.name}" for family in found.space.families]
    star_name = "the choice" if found.feasible else "the closest"
    figure, (axes,) = single(_HEIGHT_IN, [*names, "trade-off", "limit", star_name], titled=False)
    shown = []
    for i, name in enumerate(names):
        colour, marker = palette.SERIES[i % len(palette.SERIES)], _MARKERS[i % len(_MARKERS)]
        style: dict[str, Any] = {"color": printed(colour), "linestyle": "none", "marker": marker}
        own = [t.measured for t in found.trials if t.candidate.family == i]
        own = [m for m in own if np.isfinite(m.settling_s)]
        sent, settling_s = [m.transmissions for m in own], [m.settling_s for m in own]
        axes.plot(sent, settling_s, markersize=3.5, alpha=0.5, **style)
        shown.append((Line2D([], [], **style), plain(name, 24)))
    (front,) = axes.plot(
        [t.measured.transmissions for t in found.front],
        [t.measured.settling_s for t in found.front],
        drawstyle="steps-post", color=printed(palette.NETWORK), linewidth=1.4,
    )  # fmt: skip
    limit = axes.axhline(
        found.limits.settling_s, color=printed(palette.CERTIFIED), linestyle=(0, (6, 2))
    )
    best = found.fresh
    if np.isfinite(best.settling_s):
        high_s = best.settling_high_s if np.isfinite(best.settling_high_s) else best.settling_s
        axes.errorbar(
            [best.transmissions], [best.settling_s],
            yerr=[[best.settling_s - best.settling_low_s], [high_s - best.settling_s]],
            xerr=[best.halfwidth], color=printed(palette.LOST), marker="*", markersize=12,
        )  # fmt: skip
    star = Line2D([], [], color=printed(palette.LOST), marker="*", linestyle="none")
    shown += [(front, "trade-off"), (limit, "limit"), (star, star_name)]
    axes.set(
        xlabel="transmissions (mean)",
        ylabel=f"settling time, {100 * found.limits.quantile:g} % quantile [s]",
    )
    if any(np.isfinite(trial.measured.settling_s) for trial in found.trials):
        logarithmic(axes, "x")
    legend(axes, shown)
    finish(axes)
    return figure


def rows(found: DesignResult) -> list[tuple[str, ...]]:
    """Return the rows of the trade-off curve."""
    return [
        (
            plus_minus(trial.measured.transmissions, trial.measured.halfwidth),
            seconds(trial.measured),
            f"{trial.candidate.alpha_per_s:.4g}",
            f"{trial.candidate.beta:.4g}",
            found.space.families[trial.candidate.family].weight,
            found.space.families[trial.candidate.family].gain,
        )
        for trial in found.front
    ]


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
    lines = []
    if found.feasible:
        lines = [
            found.verdict(),
            f"chosen among {len(found.trials):,} candidates on {found.best.measured.draws:,} "
            f"draws; the numbers are from {found.fresh.draws:,} other draws",
        ]
    if found.bounds:
        bounds = [certified(name, value) for name, value in found.bounds.items()]
        lines.append(f"certified {found.conditions}: {', '.join(bounds)}")
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)
