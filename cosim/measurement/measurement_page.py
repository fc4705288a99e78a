"""The page of a measurement: its tables and figures, as one HTML file.

The figures show bursts, delays, correlation and (m, K).
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from cosim.measurement.certificate_time import CertificateTime
from cosim.measurement.loss_bursts import LEVEL, most_losses
from cosim.measurement.measurement_tables import measurement_tables, void_remarks
from cosim.measurement.network_measurement import Measurement
from cosim.output import palette
from cosim.output.figure_description import (
    Axis,
    Bars,
    FigureDescription,
    Item,
    Line,
    Marks,
    Panel,
    Rule,
    Spans,
    one_panel,
    time_axis,
)
from cosim.output.figure_files import save_figures
from cosim.output.figure_format import FigureFiles
from cosim.output.page_kit import templates
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
    return [write_whole(path, html), *save_figures(figures, path, figure_files)]


_BURSTS, _OUTAGES, _DELAYS = palette.SENSOR, palette.CONTROLLER, palette.PLANT
_LOST, _LIMIT = palette.LOST, palette.CERTIFIED
_HEIGHT_IN = 2.4
_WINDOWS = 40
_LONGEST_WINDOW = 1000


def measurement_figures(found: Measurement) -> Iterator[FigureDescription]:
    """Yield the figures of a measurement."""
    deadline_s = found.options.deadline_s
    limit = "" if deadline_s is None else f" Dashed: the deadline of {duration(deadline_s)}."
    yield one_panel("bursts", _histogram(found), _HEIGHT_IN).captioned(
        "Number of loss bursts by length. A burst is a number of consecutive effective "
        "losses: packets that were lost, out of order, or later than the deadline.",
        f"Bars: {len(found.bursts.length)} loss bursts, the longest of "
        f"{found.bursts.longest} packets.",
    )
    yield one_panel("delays", _delays(found), _HEIGHT_IN).captioned(
        "Delay of each received packet, at its sending time; crosses at the top: lost "
        f"packets. Shaded: outages.{limit}",
        f"Points: the delays of {found.delays.received} packets over {found.observed_s:.1f} s.",
    )
    yield one_panel("correlation", _correlation(found), _HEIGHT_IN).captioned(
        "Correlation of the delays (of their normal scores) and of the effective losses of "
        f"two packets, by their distance. Within the dashed lines: {100 * LEVEL:.0f} % of the "
        "correlations of independent delays.",
        "Curves: correlation of delays and of losses over the distance in packets.",
    )
    yield one_panel("windows", _windows(found), _HEIGHT_IN).captioned(
        "(m, K): the largest number m of effective losses in any K consecutive packets. "
        "Dashed: all K packets lost.",
        "Curve: most losses over the length of the window.",
    )


def _histogram(found: Measurement) -> Panel:
    outages = found.is_outage
    longest = found.bursts.longest
    # Bins of one length, or, if the lengths differ much, of a constant ratio.
    wide = longest > _WINDOWS
    edges = np.arange(1.0, longest + 2)
    if wide:
        edges = np.unique(np.geomspace(1, longest + 1, _WINDOWS).round())
    items = []
    for label, bursts, colour in (
        ("loss bursts", found.bursts.only(~outages), _BURSTS),
        ("outages", found.bursts.only(outages), _OUTAGES),
    ):
        counts = np.histogram(bursts.length, edges)[0].astype(np.float64)
        items.append(Bars(edges=edges - 0.5, heights=counts, label=label, colour=colour,
                          opacity=0.85))  # fmt: skip
    return Panel(
        title="Loss bursts",
        items=items,
        x=Axis(label="consecutive effective losses", logarithmic=wide, whole=not wide),
        y=Axis(label="bursts", whole=True),
        legend=None if outages.any() else (),
    )


def _delays(found: Measurement) -> Panel:
    trace = found.trace
    sent_s, lost = np.asarray(trace.sent_ns * 1e-9), trace.lost
    values = np.asarray(np.where(lost, np.nan, np.maximum(trace.delay_ns, 1)) * 1e-9)
    begin_s, duration_s = found.bursts.only(found.is_outage).times_s(trace)
    items: list[Item] = [
        Line(x=sent_s, y=values, colour=_DELAYS, width=0.8, marker=".", size=2.5),
        Spans(begin=begin_s, end=begin_s + duration_s, colour=_OUTAGES),
        Marks(x=sent_s[lost], y=np.zeros(int(lost.sum())), marker="x", size=3.5, colour=_LOST,
              at_top=True, reduced=False),
    ]  # fmt: skip
    if found.options.deadline_s is not None:
        items.append(Rule(at=found.options.deadline_s, colour=_LIMIT))
    return Panel(
        title="Delay over time",
        items=items,
        x=time_axis(sent_s, label="sending time [s]"),
        y=Axis(label="delay [s]", logarithmic=bool((~lost).any())),
    )


def _correlation(found: Measurement) -> Panel:
    delays, (lags, losses) = found.delays, found.loss_correlation
    items = [
        _curve(x, y, label, colour)
        for x, y, label, colour in (
            (delays.lags, delays.correlation, "delays", _BURSTS),
            (lags, losses, "effective losses", _LOST),
        )
        if x
    ]
    limits = [Rule(at=at, colour=_LIMIT, width=1.0) for at in (delays.white, -delays.white)]
    return Panel(
        title="Correlation",
        items=[*items, *limits],
        x=Axis(label="distance in packets", logarithmic=bool(items)),
        y=Axis(label="correlation"),
    )


def _windows(found: Measurement) -> Panel:
    longest = max(min(_LONGEST_WINDOW, len(found.trace)), 1)
    windows = np.unique(np.geomspace(1, longest, _WINDOWS).round().astype(int)).tolist()
    every = most_losses(found.bursts, windows)
    items = [_curve([*every], [*every.values()], "all packets", _OUTAGES)]
    if found.is_outage.any():
        usual = most_losses(found.bursts, windows, found.is_outage)
        items.append(_curve([*usual], [*usual.values()], "without outages", _BURSTS))
    all_lost = np.array(windows, np.float64)
    most = max(every.values())
    ends = (0.8, 1.4 * most) if most else (None, None)
    return Panel(
        title="Most losses in a window",
        items=[*items, Line(x=all_lost, y=all_lost, colour=_LIMIT, dash=(6, 2.5))],
        x=Axis(label="window K in packets", logarithmic=True),
        y=Axis(label="losses m", logarithmic=most > 0, ends=ends),
        legend=None if found.is_outage.any() else (),
    )


def _curve(x: Sequence[float], y: Sequence[float], label: str, colour: palette.Colour) -> Line:
    return Line(x=np.asarray(x, np.float64), y=np.asarray(y, np.float64), label=label,
                colour=colour, marker=".", size=4)  # fmt: skip
