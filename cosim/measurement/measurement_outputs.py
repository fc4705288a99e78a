"""The result of a measurement as a document: tables, figures (bursts, delays, correlation, (m, K))."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cosim.live.monitoring.progress import activity
from cosim.measurement.certificate_time import CertificateTime, measured_certificate_time
from cosim.measurement.network_section import Form, write_network
from cosim.output.curves import DASHED
from cosim.output.figures import palette
from cosim.output.figures.axes_parts import draw_bars, draw_line, limit_to, rgb, set_times, whole_numbers
from cosim.output.figures.figure_format import FigureFiles
from cosim.output.figures.page_figure import PageFigure, one_panel
from cosim.output.figures.palette import Colour
from netem.core.errors import CallerError
from netem.core.file_access import require_suffix
from netem.core.number_format import NONE, duration, percent
from netem.measurement.interval_estimates import LEVEL
from netem.measurement.loss_bursts import most_losses
from netem.measurement.measured_preset import write_preset
from netem.measurement.measurement_document import measurement_document
from netem.measurement.network_measurement import NetworkMeasurement
from netem.output.document import Document
from netem.output.result_tables import ResultTable
from noack.scenario.scenario import Scenario

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True)
class OutputRequest:
    """What to write besides the tables."""

    page: Path | None = None
    figure_files: FigureFiles | None = None
    """Format and width of the figures beside the page."""
    network: Path | None = None
    form: Form = "trace"
    scenario: Scenario | None = None
    """A scenario whose certificates are compared with the network."""
    preset: Path | None = None

    def __post_init__(self) -> None:
        """Refuse wrong names before anything is measured."""
        if self.figure_files is not None and self.page is None:
            raise CallerError("--format: the figures are beside the page; give --out FILE.html")
        if self.page is not None:
            require_suffix(self.page, "--out", ".html")
        if self.network is not None:
            require_suffix(self.network, "--write", ".toml")


def write_outputs(measurement: NetworkMeasurement, request: OutputRequest) -> tuple[Document, list[Path]]:
    """Write what is requested; return the document of a measurement, and the written files.

    Raises:
        NoackError: one line; a file cannot be written, or the scenario cannot be resolved.
    """
    with activity("measuring"):
        void = None if request.scenario is None else measured_certificate_time(measurement, request.scenario)
        document = outputs_document(measurement, void)
    written: list[Path] = []
    if request.page is not None:
        from cosim.output.page_kit import save_page  # imports matplotlib

        written += save_page(document, request.page, request.figure_files)
    if request.network is not None:
        written += write_network(measurement, request.network, request.form)
    if request.preset is not None:
        written.append(write_preset(measurement, request.preset))
    return document, written


def outputs_document(measurement: NetworkMeasurement, void: CertificateTime | None = None) -> Document:
    """Return tables, figures and remarks of a measurement, and of a scenario's certificate."""
    return measurement_document(
        measurement,
        figures=measurement_figures(measurement),
        tables=() if void is None else _void_tables(void),
        remarks=() if void is None else _void_remarks(void),
        data={} if void is None else {"certificate": void.to_json()},
    )


def _void_tables(void: CertificateTime) -> Iterator[ResultTable]:
    """Yield the table of a scenario's certificate."""
    caption = f"{void.scenario}: when the network violates a condition of its certificates"
    heads = ("condition", "share of the time", "first", "worst")
    yield ResultTable("certificate", caption, heads, [*_void_rows(void)])


def _void_rows(void: CertificateTime) -> Iterator[tuple[str, str, str, str]]:
    for violation in void.causes:
        yield violation.cause, percent(violation.share), f"{violation.first_s:.3f} s", violation.text
    for cause, text in void.kept.items():
        yield cause, percent(0.0), NONE, text
    first_violated = NONE if void.first_s is None else f"{void.first_s:.3f} s"
    yield "any of them", percent(void.share), first_violated, ""


def _void_remarks(void: CertificateTime) -> Iterator[str]:
    """Yield the remarks about a scenario's certificate."""
    for scope, reason in void.certificates.items():
        if reason is not None:
            yield f"no certificate for {scope}: {reason}"
    yield (
        f"each packet counts as an update of {void.scenario}; a claim about a run is void from the "
        "first violation on"
    )
    yield void.answer


_BURSTS, _OUTAGES, _DELAYS = palette.SENSOR, palette.CONTROLLER, palette.PLANT
_LOST, _LIMIT = palette.LOST, palette.CERTIFIED
_HEIGHT_IN = 2.4
_WINDOWS = 40
"""Most bars of a histogram, and most windows of a curve."""
_LONGEST_WINDOW = 1000
_MARK_HEIGHT = 0.97
"""Of the marks of lost packets, as a share of the panel's height."""


def measurement_figures(measurement: NetworkMeasurement) -> Iterator[PageFigure]:
    """Yield the figures of a measurement."""
    deadline_s = measurement.options.deadline_s
    limit = "" if deadline_s is None else f" Dashed: the deadline of {duration(deadline_s)}."
    bursts, delays = measurement.bursts, measurement.delays
    yield one_panel(
        "bursts",
        _HEIGHT_IN,
        lambda axes: _draw_histogram(axes, measurement),
        caption="Number of loss bursts by length. A burst is a number of consecutive effective "
        "losses: packets that were lost, out of order, or later than the deadline.",
        description=f"Bars: {len(bursts.length)} loss bursts, the longest of {bursts.longest} packets.",
    )
    yield one_panel(
        "delays",
        _HEIGHT_IN,
        lambda axes: _draw_delays(axes, measurement),
        caption="Delay of each received packet, at its sending time; crosses at the top: lost "
        f"packets. Shaded: outages.{limit}",
        description=f"Points: the delays of {delays.received} packets over {measurement.observed_s:.1f} s.",
    )
    yield one_panel(
        "correlation",
        _HEIGHT_IN,
        lambda axes: _draw_correlation(axes, measurement),
        caption="Correlation of the delays (of their normal scores) and of the effective losses of "
        "two packets, by their distance, without outages. Within the dashed lines: "
        f"{100 * LEVEL:.0f} % of the correlations of independent delays.",
        description="Curves: correlation of delays and of losses over the distance in packets.",
    )
    yield one_panel(
        "windows",
        _HEIGHT_IN,
        lambda axes: _draw_windows(axes, measurement),
        caption="(m, K): the largest number m of effective losses in any K consecutive packets. "
        "Dashed: all K packets lost.",
        description="Curve: most losses over the length of the window.",
    )


def _draw_histogram(axes: "Axes", measurement: NetworkMeasurement) -> None:
    outages, bursts = measurement.is_outage, measurement.bursts
    # Bins of one length, or, if the lengths differ much, of a constant ratio.
    wide = bursts.longest > _WINDOWS
    edges = np.arange(1.0, bursts.longest + 2)
    if wide:
        edges = np.unique(np.geomspace(1, bursts.longest + 1, _WINDOWS).round())
        axes.set_xscale("log")
    for label, chosen, colour in (("loss bursts", ~outages, _BURSTS), ("outages", outages, _OUTAGES)):
        counts = np.histogram(bursts.subset(chosen).length, edges)[0].astype(np.float64)
        shown_label = label if outages.any() else None
        draw_bars(axes, edges - 0.5, counts, colour, label=shown_label, alpha=0.85)
    axes.set(title="Loss bursts", xlabel="consecutive effective losses", ylabel="bursts")
    whole_numbers(axes, "y")
    if not wide:
        whole_numbers(axes, "x")


def _draw_delays(axes: "Axes", measurement: NetworkMeasurement) -> None:
    trace = measurement.trace
    sent_s, lost = np.asarray(trace.sent_ns * 1e-9), trace.lost
    unknown = lost | (trace.delays_unknown != "")
    values = np.asarray(np.where(unknown, np.nan, np.maximum(trace.delay_ns, 1)) * 1e-9)
    axes.set(title="Delay over time", ylabel="delay [s]", yscale="linear" if unknown.all() else "log")
    deadline_s = measurement.options.deadline_s
    if not unknown.all():
        limit_to(axes, np.append(values, values if deadline_s is None else deadline_s))
    draw_line(axes, sent_s, values, _DELAYS, linewidth=0.8, marker=".", markersize=2.5)
    begin_s, duration_s = measurement.bursts.subset(measurement.is_outage).times_s(trace)
    for begin, end in zip(begin_s, begin_s + duration_s, strict=True):
        axes.axvspan(begin, end, color=rgb(_OUTAGES), alpha=0.2, linewidth=0)
    axes.plot(
        sent_s[lost], np.full(int(lost.sum()), _MARK_HEIGHT), "x", color=rgb(_LOST), markersize=3.5,
        clip_on=False, transform=axes.get_xaxis_transform(),
    )  # fmt: skip
    if deadline_s is not None:
        axes.axhline(deadline_s, color=rgb(_LIMIT), dashes=DASHED, linewidth=1.6)
    set_times(axes, sent_s)
    axes.set_xlabel("sending time [s]")


def _draw_correlation(axes: "Axes", measurement: NetworkMeasurement) -> None:
    delays, losses = measurement.delays, measurement.loss_correlation
    for correlation, label, colour in (
        (delays.correlation, "delays", _BURSTS),
        (losses, "effective losses", _LOST),
    ):
        if correlation.lags:
            axes.set_xscale("log")
            _draw_dots(axes, correlation.lags, correlation.at_lags, label, colour)
    for level in (delays.white_noise_limit, -delays.white_noise_limit):
        axes.axhline(level, color=rgb(_LIMIT), dashes=DASHED, linewidth=1.0)
    axes.set(title="Correlation", xlabel="distance in packets", ylabel="correlation")


def _draw_windows(axes: "Axes", measurement: NetworkMeasurement) -> None:
    longest, has_outages = max(min(_LONGEST_WINDOW, len(measurement.trace)), 1), measurement.is_outage.any()
    windows = np.unique(np.geomspace(1, longest, _WINDOWS).round().astype(int)).tolist()
    in_all = most_losses(measurement.bursts, windows)
    largest = max(in_all.values())
    axes.set(title="Most losses in a window", xlabel="window K in packets", ylabel="losses m", xscale="log")
    if largest:
        axes.set(yscale="log", ylim=(0.8, 1.4 * largest))
    _draw_dots(axes, [*in_all], [*in_all.values()], "all packets" if has_outages else "", _OUTAGES)
    if has_outages:
        without_outages = most_losses(measurement.bursts, windows, measurement.is_outage)
        _draw_dots(axes, [*without_outages], [*without_outages.values()], "without outages", _BURSTS)
    all_lost = np.array(windows, np.float64)
    draw_line(axes, all_lost, all_lost, _LIMIT, DASHED)


def _draw_dots(axes: "Axes", x: Sequence[float], y: Sequence[float], label: str, colour: Colour) -> None:
    draw_line(
        axes, np.asarray(x, np.float64), np.asarray(y, np.float64), colour, label=label, marker=".",
        markersize=4,
    )  # fmt: skip
