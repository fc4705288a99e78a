"""The overlay of runs: their states, errors and transmissions in one figure, and a page with it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cosim.output import palette
from cosim.output.report.axes import (
    BELOW_IN,
    LEFT_IN,
    RIGHT_IN,
    TIME,
    WIDTH_IN,
    Shown,
    finish,
    finite,
    for_log_axis,
    head_in,
    legend,
    limit_log_axis,
    line,
    logarithmic,
    marks,
    place,
    plain,
)
from cosim.output.report.decimate import Reals
from cosim.output.report.figure_files import inline, save_figure
from cosim.output.report.figure_style import NotebookFigure, printed, styled
from cosim.output.report.report_page import templates
from cosim.record.align import AlignedRun, join_all
from cosim.studies.comparison.run_comparison import ComparedRun, RunComparison
from noack.core.clock import NS_PER_S
from noack.core.errors import CallerError
from noack.core.file_access import write_whole
from noack.protocol.record_tables import CONTROLLER_DELIVERY, NO_SEQUENCE, SENSOR_MEASUREMENT

_MOST_STATES = 6
_STATE_IN, _NORM_IN, _EVENTS_IN, _GAP_IN = 1.05, 1.45, 0.3, 0.2
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
        joined = [join_all(run.record) for run in runs]
    names = [f"{run.label}: {plain(run.title, 60)}" for run in runs]
    states = min(runs[0].record.loop.n, _MOST_STATES)
    heads_in = [head_in(names), *[_GAP_IN] * (states - 1), *[head_in(())] * 3]
    events_in = _EVENTS_IN * len(runs)
    heights_in = [*[_STATE_IN] * states, _NORM_IN, _NORM_IN, events_in]
    figure = NotebookFigure(figsize=(WIDTH_IN, sum(heads_in) + sum(heights_in) + BELOW_IN))
    panels: list[Axes] = []
    top_in = 0.0
    for head, height in zip(heads_in, heights_in, strict=True):
        share: dict[str, Any] = {"sharex": panels[0]} if panels else {}
        width_in = WIDTH_IN - LEFT_IN - RIGHT_IN
        panels.append(place(figure, LEFT_IN, top_in + head, width_in, height, **share))
        top_in += head + height
    shown = [_state(axes, i, joined)[: len(runs)] for i, axes in enumerate(panels[:states])]
    for i, axes in enumerate(panels[:states]):
        axes.set_ylabel(plain(runs[0].record.loop.state_names[i]))
    legend(panels[0], [(artist, name) for (artist, _), name in zip(shown[0], names, strict=True)])
    _norms(panels[states], r"Sensor's error $\|e_s\|$ and threshold (dashed)", [
        (_times(one), one.e_s_norm, one.threshold) for one in joined
    ])  # fmt: skip
    _norms(panels[states + 1], r"Controller's error $\|e_c\|$", [
        (_times(one), one.e_c_norm, None) for one in joined
    ])  # fmt: skip
    _events(panels[-1], runs)
    whole = max((_times(one) for one in joined), key=lambda t_s: t_s.max(initial=0.0))
    for axes in panels:
        axes.tick_params(labelbottom=axes is panels[-1])
        finish(axes, whole)
    panels[-1].set_xlabel(TIME)
    figure.align_ylabels()
    return figure


def _style(number: int) -> dict[str, Any]:
    """Return a run's colour and line width; each line is thinner than the line below it."""
    width = max(_WIDEST * _NARROWER**number, 0.8)
    return {"color": printed(palette.SERIES[number % len(palette.SERIES)]), "linewidth": width}


def _times(joined: AlignedRun) -> Reals:
    return np.asarray(joined.t_ns / NS_PER_S, dtype=np.float64)


def _state(axes: Axes, entry: int, joined: Sequence[AlignedRun]) -> list[Shown]:
    shown: list[Shown] = []
    for number, one in enumerate(joined):
        shown += line(axes, _times(one), finite(one.x[:, entry]), **_style(number))
    return shown


def _norms(axes: Axes, title: str, curves: Sequence[tuple[Reals, Reals, Reals | None]]) -> None:
    """Draw norms on a logarithmic axis, the first run on top; a reset reduces them to rounding."""
    logarithmic(axes, "y")
    for number, (t_s, values, threshold) in enumerate(curves):
        style = _style(number) | {"linewidth": _NORM_WIDTH, "zorder": 3 - 0.1 * number}
        line(axes, t_s, for_log_axis(values), **style)
        if threshold is not None:
            dashed = style | {"linestyle": (0, (5, 2))}
            line(axes, t_s, finite(threshold, positive=True), **dashed)
    limit_log_axis(axes, np.concatenate([values for _, values, _ in curves]), _DECADES)
    axes.set(title=title, ylabel="norm")


def _events(axes: Axes, runs: Sequence[ComparedRun]) -> None:
    """One row of marks per run: a bar for a delivered transmission, a cross for a lost one."""
    rows = range(len(runs) - 1, -1, -1)
    shown: list[Shown] = []
    for number, (run, row) in enumerate(zip(runs, rows, strict=True)):
        sensor = run.record[SENSOR_MEASUREMENT]
        sent = sensor[sensor["event"] != NO_SEQUENCE]
        delivered = np.isin(sent["event"], run.record[CONTROLLER_DELIVERY]["sequence"])
        t_s = sent["t_ns"] / NS_PER_S
        colour = _style(number)["color"]
        bar: dict[str, Any] = {"color": colour, "marker": "|", "markeredgewidth": 1.6}
        marks(axes, t_s[delivered], np.full(int(delivered.sum()), row), size=13.0, **bar)
        lost: dict[str, Any] = {"color": printed(palette.LOST), "marker": "x"}
        crosses = marks(axes, t_s[~delivered], np.full(int((~delivered).sum()), row), "lost",
                        size=4.5, **lost)  # fmt: skip
        shown = shown or crosses
    axes.set(title="Transmissions (bar: delivered, cross: lost)", ylim=(-0.6, len(runs) - 0.4))
    axes.set_yticks(list(rows), [run.label for run in runs])
    axes.grid(visible=False, axis="y")
    legend(axes, shown)


def write_overlay(comparison: RunComparison, path: Path) -> None:
    """Write the overlay of runs to a page or a figure; see :meth:`RunComparison.save`."""
    if path.suffix not in (".html", ".svg", ".png"):
        raise CallerError(f"{path}: a comparison is written as .html, .svg or .png")
    figure = overlay_figure(comparison.runs)
    if path.suffix == ".html":
        markup = Markup(inline(figure, "overlay", _DESCRIPTION))
        template = templates().get_template("overlay.html.jinja")
        write_whole(path, template.render(found=comparison, figure=markup))
    else:
        save_figure(figure, path)
