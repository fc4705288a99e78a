"""The page of a measurement: its tables and figures, as one HTML file.

The figures show bursts, delays, correlation and (m, K).
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from cosim.measurement.certificate_time import CertificateTime
from cosim.measurement.loss_bursts import LEVEL, most_losses
from cosim.measurement.measurement_tables import measurement_tables, void_remarks
from cosim.measurement.network_measurement import Measurement
from cosim.output import palette
from cosim.output.figure_format import FigureFiles
from cosim.output.report import axes as draw
from cosim.output.report.figure_files import save_figures
from cosim.output.report.figure_style import printed, styled
from cosim.output.report.report_page import templates
from noack.core.file_access import require_suffix, write_whole
from noack.core.number_format import duration


def write_page(
    found: Measurement,
    void: CertificateTime | None,
    path: Path,
    figure_files: FigureFiles | None = None,
) -> list[Path]:
    """Write the page, in which all text is escaped, and its figures; return the files.

    Raises:
        CallerError: the name does not end in .html.
        MachineError: the page cannot be written.
    """
    require_suffix(path, "--out", ".html")
    template = templates(Path(__file__).parent).get_template("measurement.html.jinja")
    figures = list(measurement_figures(found))
    html = template.render(
        found=found,
        remarks=[*found.remarks, *void_remarks(void)],
        tables=list(measurement_tables(found, void)),
        figures=figures,
    )
    named = ((one.name, one.figure) for one in measurement_figures(found))
    return [write_whole(path, html), *save_figures(named, path, figure_files)]


_BURSTS, _OUTAGES, _DELAYS = map(printed, (palette.SENSOR, palette.CONTROLLER, palette.PLANT))
_LOST, _LIMIT = map(printed, (palette.LOST, palette.CERTIFIED))
_HEIGHT_IN = 2.4
_WINDOWS = 40
_LONGEST_WINDOW = 1000


class MeasurementFigure(NamedTuple):
    """A figure with its caption."""

    name: str
    figure: Figure
    caption: str
    description: str
    """Text alternative of the figure."""


def measurement_figures(found: Measurement) -> Iterator[MeasurementFigure]:
    """Yield the figures of a measurement."""
    deadline_s = found.options.deadline_s
    limit = "" if deadline_s is None else f" Dashed: the deadline of {duration(deadline_s)}."
    yield MeasurementFigure(
        "bursts", _histogram(found),
        "Number of loss bursts by length. A burst is a number of consecutive effective losses: "
        "packets that were lost, out of order, or later than the deadline.",
        f"Bars: {len(found.bursts.length)} loss bursts, the longest of {found.bursts.longest} "
        "packets.",
    )  # fmt: skip
    yield MeasurementFigure(
        "delays", _delays(found),
        "Delay of each received packet, at its sending time; crosses at the top: lost packets. "
        f"Shaded: outages.{limit}",
        f"Points: the delays of {found.delays.received} packets over {found.observed_s:.1f} s.",
    )  # fmt: skip
    yield MeasurementFigure(
        "correlation", _correlation(found),
        "Correlation of the delays (of their normal scores) and of the effective losses of two "
        f"packets, by their distance. Within the dashed lines: {100 * LEVEL:.0f} % of the "
        "correlations of independent delays.",
        "Curves: correlation of delays and of losses over the distance in packets.",
    )  # fmt: skip
    yield MeasurementFigure(
        "windows", _windows(found),
        "(m, K): the largest number m of effective losses in any K consecutive packets. Dashed: "
        "all K packets lost.",
        "Curve: most losses over the length of the window.",
    )  # fmt: skip


@styled
def _histogram(found: Measurement) -> Figure:
    shown_as = ("loss bursts", "outages") if found.is_outage.any() else ()
    figure, (axes,) = draw.single(_HEIGHT_IN, shown_as)
    groups = ((found.bursts.only(~found.is_outage), _BURSTS), (
        found.bursts.only(found.is_outage), _OUTAGES))  # fmt: skip
    longest = found.bursts.longest
    # Bins of one length, or, if the lengths differ much, of a constant ratio.
    wide = longest > _WINDOWS
    edges = np.unique(np.geomspace(1, longest + 1, _WINDOWS).round()) if wide else (
        np.arange(1, longest + 2))  # fmt: skip
    shown: list[draw.Shown] = []
    for label, (bursts, colour) in zip(("loss bursts", "outages"), groups, strict=True):
        if len(bursts.length):
            counts, _ = np.histogram(bursts.length, edges)
            bars = axes.bar(
                edges[:-1] - 0.5, counts, np.diff(edges), align="edge", color=colour, alpha=0.85
            )
            shown.append((bars.patches[0], label))
    if wide:
        draw.logarithmic(axes, "x")
    else:
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set(title="Loss bursts", xlabel="consecutive effective losses", ylabel="bursts")
    draw.legend(axes, shown if shown_as else ())
    draw.finish(axes)
    return figure


@styled
def _delays(found: Measurement) -> Figure:
    figure, (axes,) = draw.single(_HEIGHT_IN, ())
    trace = found.trace
    sent_s, lost = np.asarray(trace.sent_ns * 1e-9), trace.lost
    values = np.asarray(np.where(lost, np.nan, np.maximum(trace.delay_ns, 1)) * 1e-9)
    if (~lost).any():
        draw.logarithmic(axes, "y")
        draw.line(
            axes, sent_s, values, color=_DELAYS, linewidth=0.8, marker=".", markersize=2.5,
            label="delay",
        )  # fmt: skip
    for begin_s, duration_s in zip(*found.bursts.only(found.is_outage).times_s(trace), strict=True):
        axes.axvspan(begin_s, begin_s + duration_s, color=_OUTAGES, alpha=0.2, linewidth=0)
    if found.options.deadline_s is not None:
        axes.axhline(found.options.deadline_s, color=_LIMIT, linestyle=(0, (6, 2.5)))
    if lost.any():
        top = np.full(int(lost.sum()), 0.97)
        axes.plot(
            sent_s[lost], top, linestyle="none", marker="x", markersize=3.5, color=_LOST,
            transform=axes.get_xaxis_transform(),
        )  # fmt: skip
    axes.set(title="Delay over time", xlabel="sending time [s]", ylabel="delay [s]")
    draw.finish(axes, sent_s)
    return figure


@styled
def _correlation(found: Measurement) -> Figure:
    labels = ("delays", "effective losses")
    figure, (axes,) = draw.single(_HEIGHT_IN, labels)
    delays, shown = found.delays, []
    if delays.lags:
        shown += _curve(axes, delays.lags, delays.correlation, "delays", _BURSTS)
    lags, losses = found.loss_correlation
    if lags:
        shown += _curve(axes, lags, losses, "effective losses", _LOST)
    for white in (delays.white, -delays.white):
        axes.axhline(white, color=_LIMIT, linestyle=(0, (6, 2.5)), linewidth=1.0)
    if shown:
        draw.logarithmic(axes, "x")
    axes.set(title="Correlation", xlabel="distance in packets", ylabel="correlation")
    draw.legend(axes, shown)
    draw.finish(axes)
    return figure


@styled
def _windows(found: Measurement) -> Figure:
    has_outages = bool(found.is_outage.any())
    labels = ("all packets", "without outages") if has_outages else ()
    figure, (axes,) = draw.single(_HEIGHT_IN, labels)
    longest = max(min(_LONGEST_WINDOW, len(found.trace)), 1)
    windows = np.unique(np.geomspace(1, longest, _WINDOWS).round().astype(int)).tolist()
    every = most_losses(found.bursts, windows)
    shown = _curve(axes, [*every], [*every.values()], "all packets", _OUTAGES)
    if has_outages:
        usual = most_losses(found.bursts, windows, found.is_outage)
        shown += _curve(axes, [*usual], [*usual.values()], "without outages", _BURSTS)
    axes.plot(windows, windows, color=_LIMIT, linestyle=(0, (6, 2.5)))
    draw.logarithmic(axes, "x")
    if any(every.values()):
        draw.logarithmic(axes, "y")
        axes.set_ylim(0.8, 1.4 * max(every.values()))
    axes.set(title="Most losses in a window", xlabel="window K in packets", ylabel="losses m")
    draw.legend(axes, shown if has_outages else ())
    draw.finish(axes)
    return figure


def _curve(axes: Axes, x: object, y: object, label: str, colour: object) -> list[draw.Shown]:
    (line,) = axes.plot(x, y, color=colour, marker=".", markersize=4)  # type: ignore[arg-type]
    return [(line, label)]
