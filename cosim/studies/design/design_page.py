"""The output of a design: one page (HTML) with figure and tables, and a table for a terminal.

A design is of a trigger (:class:`~cosim.studies.design.design_search.DesignResult`) or of a loop
for a network (:class:`~cosim.studies.design.design_outcome.DesignOutcome`).
"""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console

from cosim.output.curves import DASHED
from cosim.output.figures import palette
from cosim.output.figures.axes_parts import MARKERS, draw_line, draw_points, label_text, rgb, series_colour
from cosim.output.figures.figure_files import save_figures
from cosim.output.figures.figure_format import FigureFiles
from cosim.output.figures.page_figure import PageFigure, one_panel
from cosim.output.page_kit import templates
from cosim.output.result_tables import ResultTable, terminal_table
from cosim.record.run_directory import write_output
from cosim.studies.design.design_outcome import HEIGHT_IN, DesignOutcome
from cosim.studies.design.design_search import WORDS, DesignResult, certified
from noack.core.number_format import plus_minus
from noack.scenario.scenario_file import dumps

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_CAPTION = (
    "Mean number of transmissions and quantile of the settling times of each candidate, all on the "
    "same draws. Candidates that settle too rarely to have a quantile are left out. The star is "
    "the chosen candidate on new draws."
)
_FRONT_CAPTION = "The trade-off curve; intervals have 95 % confidence, not corrected for the selection"
_MOST_ROWS = 20
HEADINGS = ("transmissions", "settling time", "α [1/s]", "β", "weight", "gain")
_LOOP_HEADINGS = ("", "given", "designed")


def _write(path: Path, figure: PageFigure, figure_files: FigureFiles | None, **content: object) -> list[Path]:
    template = templates(Path(__file__).parent).get_template("design.html.jinja")
    html = template.render(figure=figure, **content)
    return [write_output(path, html), *save_figures([figure], path, figure_files)]


def write_page(result: DesignResult, path: Path, figure_files: FigureFiles | None = None) -> list[Path]:
    """Write page and figure; return the files. All text except the figure is escaped.

    Raises:
        MachineError: they cannot be written.
    """
    limits, bounds = result.limits, result.bounds or {}
    tone = "doubt" if result.feasible else "bad"
    return _write(
        path,
        trade_off(result),
        figure_files,
        title=result.name,
        kind="design",
        subtitle=f"{len(result.trials):,} candidates, {result.fresh.draws:,} draws, seed {result.seed}",
        verdict=result.verdict(),
        tone="good" if result.confirmed else tone,
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


def trade_off(result: DesignResult) -> PageFigure:
    """Return all tried candidates, the trade-off curve, the limit and the chosen candidate."""
    return one_panel("trade-off", HEIGHT_IN, lambda axes: _draw_trade_off(axes, result), caption=_CAPTION)


def _draw_trade_off(axes: "Axes", result: DesignResult) -> None:
    if any(np.isfinite(trial.measured.settling_s) for trial in result.trials):
        axes.set_xscale("log")
    for i, family in enumerate(result.space.families):
        measured = [t.measured for t in result.trials if t.candidate.family == i]
        measured = [m for m in measured if np.isfinite(m.settling_s)]
        axes.plot(
            [m.transmissions for m in measured], [m.settling_s for m in measured],
            MARKERS[i % len(MARKERS)], color=rgb(series_colour(i)), markersize=3.5, alpha=0.5,
            label=label_text(f"W {family.name}", 24),
        )  # fmt: skip
    front, best = [trial.measured for trial in result.front], result.fresh
    draw_line(
        axes, np.array([m.transmissions for m in front]), np.array([m.settling_s for m in front]),
        palette.NETWORK, label="trade-off", drawstyle="steps-post", linewidth=1.4,
    )  # fmt: skip
    axes.axhline(
        result.limits.settling_s, color=rgb(palette.CERTIFIED), label="limit", dashes=DASHED, linewidth=1.6
    )
    high_s = best.settling_high_s if np.isfinite(best.settling_high_s) else best.settling_s
    draw_points(
        axes, np.array([best.transmissions]), np.array([best.settling_s]), np.array([best.halfwidth]),
        np.array([[best.settling_s - best.settling_low_s], [high_s - best.settling_s]]), palette.LOST,
        marker="*", markersize=12, label="the choice" if result.feasible else "the closest",
    )  # fmt: skip
    axes.set(
        xlabel="transmissions (mean)",
        ylabel=f"settling time, {100 * result.limits.quantile:g} % quantile [s]",
    )


def rows(result: DesignResult) -> list[tuple[str, ...]]:
    """Return the rows of the trade-off curve."""
    return [
        (
            plus_minus(trial.measured.transmissions, trial.measured.halfwidth),
            trial.measured.settling,
            f"{trial.candidate.alpha_per_s:.4g}",
            f"{trial.candidate.beta:.4g}",
            result.space.families[trial.candidate.family].weight,
            result.space.families[trial.candidate.family].gain
            + (" ← chosen" if result.feasible and trial is result.best else ""),
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


def write_outcome(outcome: DesignOutcome, path: Path, figure_files: FigureFiles | None = None) -> list[Path]:
    """Write page and figure; return the files.

    Raises:
        MachineError: they cannot be written.
    """
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
        tables=[("Both loops", _LOOP_HEADINGS, outcome.rows, 1)],
        scenario_toml=outcome.scenario_toml(),
    )


def print_loop_design(console: Console, outcome: DesignOutcome) -> None:
    """Print the comparison, the verdict, and the lines for the scenario."""
    title = f"{outcome.name}: loops under the worst losses"
    table = ResultTable("design", title, _LOOP_HEADINGS, outcome.rows)
    console.print(terminal_table(table, left=range(3)))
    lines = [outcome.verdict, *outcome.notes]
    if outcome.is_certified:
        lines.append(f"for the scenario:\n{outcome.lines.rstrip()}")
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)
