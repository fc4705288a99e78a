"""The overlay of runs: their states, errors and transmissions in one figure, and a page with it."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cosim.analysis.value_reduction import Reals
from cosim.output import palette
from cosim.output.figure_description import (
    TIME,
    Axis,
    Dash,
    FigureDescription,
    Item,
    Line,
    Marks,
    Panel,
    Row,
    plain,
    series_colour,
    time_axis,
)
from cosim.output.figure_files import FIGURE_SUFFIXES, save_figure
from cosim.output.page_kit import templates
from cosim.record.align import AlignedRun, align_tables
from cosim.studies.run_comparison import ComparedRun, RunComparison
from noack.core.clock import NS_PER_S
from noack.core.errors import CallerError
from noack.core.file_access import write_whole
from noack.protocol.record_tables import CONTROLLER_DELIVERY, NO_SEQUENCE, SENSOR_MEASUREMENT

_MOST_STATES = 6
_STATE_IN, _NORM_IN, _EVENTS_IN = 1.25, 1.8, 0.35
_DECADES = 5
_WIDEST, _NARROWER, _NORM_WIDTH = 3.4, 0.75, 1.2
_CAPTION = (
    "One colour per run. Dashed: threshold. Bar: transmission delivered; cross: transmission lost."
)
_DESCRIPTION = "States, error norms and transmissions of the runs over time, overlaid."


def overlay_figure(runs: Sequence[ComparedRun]) -> FigureDescription:
    """Describe states, ‖e_s‖ with thresholds, ‖e_c‖ and transmissions, one colour per run.

    Args:
        runs: runs with the same number of states; the first 6 states are drawn.
    """
    with np.errstate(all="ignore"):  # a run may diverge
        joined = [align_tables(run.record) for run in runs]
    times = [np.asarray(one.t_ns / NS_PER_S, dtype=np.float64) for one in joined]
    whole = time_axis(max(times, key=lambda t_s: t_s.max(initial=0.0)), numbers=False)
    labels = [f"{run.label}: {plain(run.title, 60)}" for run in runs]
    states = [
        Panel(x=whole, y=Axis(label=plain(name)), legend=() if i else None, items=[
            Line(x=t_s, y=one.x[:, i], label=label, colour=series_colour(k), width=_width(k))
            for k, (t_s, one, label) in enumerate(zip(times, joined, labels, strict=True))
        ])
        for i, name in enumerate(runs[0].record.loop.state_names[:_MOST_STATES])
    ]  # fmt: skip
    norms = [
        _norms(r"Sensor's error $\|e_s\|$ and threshold (dashed)", times, joined, "e_s_norm"),
        _norms(r"Controller's error $\|e_c\|$", times, joined, "e_c_norm"),
    ]
    norms = [replace(panel, x=whole) for panel in norms]
    events = replace(_events(runs), x=replace(whole, label=TIME, numbers=True))
    return FigureDescription(
        name="runs",
        heading=f"{len(runs)} runs",
        rows=[
            *(Row(panels=[panel], height_in=_STATE_IN) for panel in states),
            *(Row(panels=[panel], height_in=_NORM_IN) for panel in norms),
            Row(panels=[events], height_in=_EVENTS_IN * (len(runs) + 1)),
        ],
        caption=_CAPTION,
        description=_DESCRIPTION,
    )


def _width(number: int) -> float:
    """Return the width of a run's line, which is thinner than the line below it."""
    return float(max(_WIDEST * _NARROWER**number, 0.8))


def _norms(title: str, times: Sequence[Reals], joined: Sequence[AlignedRun], name: str) -> Panel:
    """Describe norms on a logarithmic axis, the first run on top; a reset is a fall."""
    items: list[Item] = []
    for number, (t_s, one) in enumerate(zip(times, joined, strict=True)):
        colour, order = series_colour(number), 3 - 0.1 * number
        curves: list[tuple[Reals, Dash]] = [(getattr(one, name), ())]
        curves += [(one.threshold, (5, 2))] if name == "e_s_norm" else []
        items += [
            Line(x=t_s, y=values, colour=colour, width=_NORM_WIDTH, order=order, dash=dash)
            for values, dash in curves
        ]
    about = np.concatenate([getattr(one, name) for one in joined])
    y = Axis(label="norm", logarithmic=True, about=about, decades=_DECADES)
    return Panel(title=title, items=items, x=Axis(), y=y)


def _events(runs: Sequence[ComparedRun]) -> Panel:
    """One row of marks per run: a bar for a delivered transmission, a cross for a lost one."""
    rows = range(len(runs) - 1, -1, -1)
    items: list[Item] = []
    for number, (run, row) in enumerate(zip(runs, rows, strict=True)):
        sensor = run.record[SENSOR_MEASUREMENT]
        sent = sensor[sensor["event"] != NO_SEQUENCE]
        delivered = np.isin(sent["event"], run.record[CONTROLLER_DELIVERY]["sequence"])
        t_s = sent["t_ns"] / NS_PER_S
        items += [
            Marks(x=t_s[delivered], y=np.full(int(delivered.sum()), float(row)), marker="|",
                  size=13.0, stroke=1.6, colour=series_colour(number)),
            Marks(x=t_s[~delivered], y=np.full(int((~delivered).sum()), float(row)), marker="x",
                  size=4.5, colour=palette.LOST, label="lost"),
        ]  # fmt: skip
    ticks = {float(row): run.label for row, run in zip(rows, runs, strict=True)}
    y = Axis(ticks=ticks, ends=(-0.6, len(runs) - 0.4), grid=False)
    title = "Transmissions (bar: delivered, cross: lost)"
    return Panel(title=title, items=items, x=Axis(), y=y)


def write_overlay(comparison: RunComparison, path: Path, width: str | float | None = None) -> None:
    """Write the overlay of runs to a page or a figure; see :meth:`RunComparison.save`."""
    if path.suffix not in (".html", *FIGURE_SUFFIXES):
        known = ", ".join(FIGURE_SUFFIXES)
        raise CallerError(f"{path}: a comparison is written as .html, {known}")
    if path.suffix == ".html":
        if width is not None:
            raise CallerError(f"{path}: a page has its own width; --width is that of a figure")
        template = templates(Path(__file__).parent).get_template("overlay.html.jinja")
        write_whole(path, template.render(found=comparison, figure=overlay_figure(comparison.runs)))
    else:
        save_figure(overlay_figure(comparison.runs), path, width)
