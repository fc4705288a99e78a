"""The overlay of runs: their states, errors and transmissions in one figure, and a page with it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cosim.output import palette
from cosim.output.report import axes as draw
from cosim.output.report.figure_files import FIGURE_SUFFIXES, inline, save_drawn
from cosim.output.report.figure_style import NotebookFigure, printed, styled
from cosim.output.report.report_page import templates
from cosim.record.align import AlignedRun, align_tables
from cosim.record.decimate import Reals
from cosim.studies.run_comparison import ComparedRun, RunComparison
from noack.core.clock import NS_PER_S
from noack.core.errors import CallerError
from noack.core.file_access import write_whole
from noack.protocol.record_tables import CONTROLLER_DELIVERY, NO_SEQUENCE, SENSOR_MEASUREMENT

_MOST_STATES = 6
_STATE_IN, _NORM_IN, _EVENTS_IN, _SPACE_IN = 1.25, 1.8, 0.35, 1.0
_DECADES = 5
_WIDEST, _NARROWER, _NORM_WIDTH = 3.4, 0.75, 1.2
_DESCRIPTION = "States, error norms and transmissions of the runs over time, overlaid."


@styled
def overlay_figure(runs: Sequence[ComparedRun]) -> Figure:
    """Draw states, ‖e_s‖ with thresholds, ‖e_c‖ and transmissions of runs, one colour per run.

    Args:
        runs: runs with the same number of states; the first 6 states are drawn.
    """
    with np.errstate(all="ignore"):  # a run may diverge
        joined = [align_tables(run.record) for run in runs]
    states = min(runs[0].record.loop.n, _MOST_STATES)
    heights_in = [*[_STATE_IN] * states, _NORM_IN, _NORM_IN, _EVENTS_IN * (len(runs) + 1)]
    size_in = (draw.layout().width_in, draw.layout().scale * (sum(heights_in) + _SPACE_IN))
    figure = NotebookFigure(figsize=size_in, layout="constrained")
    panels = figure.subplots(len(heights_in), sharex=True, height_ratios=heights_in)
    for i, axes in enumerate(panels[:states]):
        for number, one in enumerate(joined):
            values = draw.finite(one.x[:, i])
            (curve, _), *_ = draw.line(axes, _times(one), values, **_style(number))
            if i == 0:
                curve.set_label(f"{runs[number].label}: {draw.plain(runs[number].title, 60)}")
        axes.set_ylabel(draw.plain(runs[0].record.loop.state_names[i]))
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper left")
    _norms(panels[states], r"Sensor's error $\|e_s\|$ and threshold (dashed)", [
        (_times(one), one.e_s_norm, one.threshold) for one in joined
    ])  # fmt: skip
    _norms(panels[states + 1], r"Controller's error $\|e_c\|$", [
        (_times(one), one.e_c_norm, None) for one in joined
    ])  # fmt: skip
    _events(panels[-1], runs)
    whole = max((_times(one) for one in joined), key=lambda t_s: t_s.max(initial=0.0))
    for axes in panels:
        draw.finish(axes, whole)
    panels[-1].set_xlabel(draw.TIME)
    figure.align_ylabels()
    return figure


def _style(number: int) -> dict[str, Any]:
    """Return a run's colour and line width; each line is thinner than the line below it."""
    width = max(_WIDEST * _NARROWER**number, 0.8)
    return {"color": printed(palette.SERIES[number % len(palette.SERIES)]), "linewidth": width}


def _times(joined: AlignedRun) -> Reals:
    return np.asarray(joined.t_ns / NS_PER_S, dtype=np.float64)


def _norms(axes: Axes, title: str, curves: Sequence[tuple[Reals, Reals, Reals | None]]) -> None:
    """Draw norms on a logarithmic axis, the first run on top; a reset reduces them to rounding."""
    draw.logarithmic(axes, "y")
    for number, (t_s, values, threshold) in enumerate(curves):
        style = _style(number) | {"linewidth": _NORM_WIDTH, "zorder": 3 - 0.1 * number}
        draw.line(axes, t_s, draw.for_log_axis(values), **style)
        if threshold is not None:
            dashed = style | {"linestyle": (0, (5, 2))}
            draw.line(axes, t_s, draw.finite(threshold, positive=True), **dashed)
    draw.limit_log_axis(axes, np.concatenate([values for _, values, _ in curves]), _DECADES)
    axes.set(title=title, ylabel="norm")


def _events(axes: Axes, runs: Sequence[ComparedRun]) -> None:
    """One row of marks per run: a bar for a delivered transmission, a cross for a lost one."""
    rows = range(len(runs) - 1, -1, -1)
    shown: list[draw.Shown] = []
    for number, (run, row) in enumerate(zip(runs, rows, strict=True)):
        sensor = run.record[SENSOR_MEASUREMENT]
        sent = sensor[sensor["event"] != NO_SEQUENCE]
        delivered = np.isin(sent["event"], run.record[CONTROLLER_DELIVERY]["sequence"])
        t_s = sent["t_ns"] / NS_PER_S
        colour = _style(number)["color"]
        bar: dict[str, Any] = {"color": colour, "marker": "|", "markeredgewidth": 1.6}
        draw.marks(axes, t_s[delivered], np.full(int(delivered.sum()), row), size=13.0, **bar)
        lost: dict[str, Any] = {"color": printed(palette.LOST), "marker": "x"}
        crosses = draw.marks(axes, t_s[~delivered], np.full(int((~delivered).sum()), row), "lost",
                        size=4.5, **lost)  # fmt: skip
        shown = shown or crosses
    axes.set(title="Transmissions (bar: delivered, cross: lost)", ylim=(-0.6, len(runs) - 0.4))
    axes.set_yticks(list(rows), [run.label for run in runs])
    axes.grid(visible=False, axis="y")
    draw.legend(axes, shown)


def write_overlay(comparison: RunComparison, path: Path, width: str | float | None = None) -> None:
    """Write the overlay of runs to a page or a figure; see :meth:`RunComparison.save`."""
    if path.suffix not in (".html", *FIGURE_SUFFIXES):
        known = ", ".join(FIGURE_SUFFIXES)
        raise CallerError(f"{path}: a comparison is written as .html, {known}")
    if path.suffix == ".html":
        if width is not None:
            raise CallerError(f"{path}: a page has its own width; --width is that of a figure")
        figure = overlay_figure(comparison.runs)
        markup = Markup(inline(figure, "overlay", _DESCRIPTION))
        template = templates(Path(__file__).parent).get_template("overlay.html.jinja")
        write_whole(path, template.render(found=comparison, figure=markup))
    else:
        save_drawn(lambda: overlay_figure(comparison.runs), path, width)
