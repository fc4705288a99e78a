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
from netem.core.number_format import (
    NONE,
    availability_percent,
    counted,
    duration,
    long_duration,
    number,
    percent,
)
from netem.impairments.burst_prediction import chance_text
from netem.measurement.interval_estimates import LEVEL, IntervalEstimate
from netem.measurement.loss_bursts import histogram, most_losses
from netem.measurement.measured_preset import write_preset
from netem.measurement.network_measurement import NetworkMeasurement
from netem.output.document import Document, Sentence, SentenceRole
from netem.output.result_tables import KEY_VALUE, ResultTable
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
        document = measurement_document(measurement, void)
    written: list[Path] = []
    if request.page is not None:
        from cosim.output.page_kit import save_page  # imports matplotlib

        written += save_page(document, request.page, request.figure_files)
    if request.network is not None:
        written += write_network(measurement, request.network, request.form)
    if request.preset is not None:
        written.append(write_preset(measurement, request.preset))
    return document, written


def measurement_document(measurement: NetworkMeasurement, void: CertificateTime | None = None) -> Document:
    """Return tables, figures and remarks of a measurement, and of a scenario's certificate."""
    remarks = (*measurement.remarks, *void_remarks(void))
    outages, longest = int(measurement.is_outage.sum()), measurement.longest_loss_burst
    also = f", and {outages} outage{'s' * (outages > 1)}" if outages else ""
    where = "Outside the outages, at" if outages else "At"
    return Document(
        title=measurement.name,
        kind="network measured",
        data=measurement.to_json() | ({} if void is None else {"certificate": void.to_json()}),
        blocks=[
            Sentence(text=f"M = {longest + 1}{also}", role=SentenceRole.VERDICT, lead=f"{measurement.name}:"),
            Sentence(
                text=f"{where} most M − 1 = {longest} consecutive packets were not effectively delivered.",
                role=SentenceRole.REMARK,
                is_prose=True,
            ),
            *measurement_figures(measurement),
            *measurement_tables(measurement, void),
            *(Sentence(text=line, role=SentenceRole.REMARK, is_prose=True) for line in remarks),
        ],
    )


_MODELS = {"bernoulli": "independent losses", "gilbert": "Gilbert", "gilbert_elliott": "Gilbert–Elliott"}
_PARAMETERS = {
    "probability": "loss probability",
    "good_to_bad": "p, good to bad",
    "bad_to_good": "r, bad to good",
    "loss_in_good": "loss in the good state",
    "loss_in_bad": "loss in the bad state",
}
_SHOWN_DELAYS = {0.5: "p50", 0.9: "p90", 0.99: "p99", 0.999: "p99.9", 1.0: "max"}
_MOST_LISTED = 12
_MOST_OUTAGES = 5


def measurement_tables(
    measurement: NetworkMeasurement, void: CertificateTime | None = None
) -> Iterator[ResultTable]:
    """Yield the tables of a measurement, and that of a scenario's certificate."""
    suffix = ", without the outages" if measurement.is_outage.any() else ""
    estimates = ("estimate", "95 % interval")
    heads: tuple[str, ...]
    yield ResultTable("numbers", "losses and delays", KEY_VALUE, [*_numbers(measurement, suffix)])
    rows = [
        (
            f"{100 * quantile.share:.6g} %",
            str(quantile.bursts),
            str(quantile.bursts_confident or "too few bursts"),
            str(quantile.packets),
        )
        for quantile in measurement.quantiles
    ]
    heads = ("share", "of the bursts", "with 95 % confidence", "of the packets")
    yield ResultTable("m", f"M: at most M − 1 consecutive losses{suffix}", heads, rows)
    if prediction := measurement.burst_prediction:
        chances = [
            (str(cap), chance_text(chance), str(measurement.longer_bursts(cap)))
            for cap, chance in prediction.chance.items()
        ]
        model = _MODELS[measurement.chosen.fit.model]
        caption = f"chance of a loss burst longer than M − 1 within {prediction.packets} packets{suffix}"
        heads = ("M − 1", f"chance, by the preferred model ({model})", "longer bursts in the trace")
        yield ResultTable("longer", caption, heads, chances)
    if measurement.windows:
        columns = 3 if suffix else 2
        windows = [
            (str(window), str(in_all), NONE if without_outages is None else str(without_outages))[:columns]
            for window, (in_all, without_outages) in measurement.windows.items()
        ]
        heads = ("K", "m", "m in windows without an outage")
        caption = "(m, K): most losses m in any K consecutive packets"
        yield ResultTable("windows", caption, heads[:columns], windows)
    if measurement.models:
        heads = ("model and parameter", *estimates)
        yield ResultTable("models", f"loss models{suffix}", heads, [*_model_rows(measurement)])
    if (service := measurement.service) is not None:
        heads = ("", *estimates)
        caption = (
            f"availability for a transfer interval of {duration(service.interval_s)} and a survival time of "
            f"{duration(service.survival_s)}: {service.survived} losses in a row are survived"
        )
        yield ResultTable("availability", caption, heads, [*_availability_rows(measurement, suffix)])
    heads = ("parameter", *estimates)
    yield ResultTable("outages", "model of the outages", heads, [*_outage_rows(measurement)])
    if void is not None:
        caption = f"{void.scenario}: when the network violates a condition of its certificates"
        heads = ("condition", "share of the time", "first", "worst")
        yield ResultTable("certificate", caption, heads, [*_void_rows(void)])


def _numbers(measurement: NetworkMeasurement, suffix: str) -> Iterator[tuple[str, str]]:
    count, deadline_s = len(measurement.trace), measurement.options.deadline_s
    yield "packets", f"{count} in {measurement.observed_s:.1f} s"
    yield "lost", _share(int(measurement.outcomes.lost.sum()), count)
    yield "out of order (stale)", _share(int(measurement.outcomes.out_of_order.sum()), count)
    if deadline_s is not None:
        name = f"later than the deadline of {duration(deadline_s)}"
        yield name, _share(int(measurement.outcomes.late.sum()), count)
    yield "effective losses (all of these)", _share(measurement.bursts.losses, count)
    bursts = measurement.bursts
    if len(bursts.length):
        lengths = [f"{count} × {length}" for length, count in histogram(bursts).items()]
        if len(lengths) > _MOST_LISTED:
            lengths[_MOST_LISTED // 2 : -_MOST_LISTED // 2] = ["…"]
        yield "loss bursts (number × length)", ", ".join(lengths)
        if measurement.mean_burst is not None:
            yield f"mean loss burst{suffix}", f"{measurement.mean_burst:.3g} packets"
        yield "longest loss burst", _burst(measurement, int(np.argmax(bursts.length)))
        outages = np.flatnonzero(measurement.is_outage).tolist()
        yield "outages", str(len(outages)) if outages else f"none: {measurement.outage_rule.reason}"
        for outage in outages[:_MOST_OUTAGES]:
            yield "  outage", _burst(measurement, outage)
        if outages:
            yield "  rule", measurement.outage_rule.reason
    longest = measurement.longest_loss_burst
    yield f"M{suffix}", f"{longest + 1} (maximum consecutive losses M − 1: {longest})"
    if (fewest := measurement.fewest_deliveries) is not None:
        yield "fewest deliveries between two bursts", str(fewest)
    delays = measurement.delays
    if measurement.trace.delays_unknown:
        yield "delay", "not known (see below)"
    if delays.received:
        values = (duration(delays.quantiles_s[share]) for share in _SHOWN_DELAYS)
        yield f"delay {' / '.join(_SHOWN_DELAYS.values())}", " / ".join(values)
    if delays.jitter is not None:
        last, largest = (duration(value) for value in delays.jitter)
        yield "jitter by RFC 3550, last / max", f"{last} / {largest}"
    if delays.correlation.lags:
        yield "correlation of successive delays", f"{delays.correlation.at_lags[0]:.2f}"


def _share(count: int, total: int) -> str:
    return f"{count} ({percent(count / total)})" if count else "0"


def _burst(measurement: NetworkMeasurement, index: int) -> str:
    burst = measurement.burst_json(index)
    return f"{burst['losses']} packets, {burst['duration_s']:.3g} s, from {burst['begin_s']:.3f} s"


def _model_rows(measurement: NetworkMeasurement) -> Iterator[tuple[str, str, str]]:
    for name, model in measurement.models.items():
        mark = " (closest)" if name == measurement.chosen.fit.model else ""
        yield f"{_MODELS[name]}{mark}", "", ""
        for parameter, estimate in model.fit.estimates.items():
            yield f"  {_PARAMETERS[parameter]}", *_estimate(estimate)
        yield "  mean loss rate", number(model.fit.rates.loss_rate), ""
        yield "  fit", model.test.verdict, model.test.numbers_text


def _estimate(estimate: IntervalEstimate | None) -> tuple[str, str]:
    if estimate is None:
        return "not determined", ""
    return number(estimate.value), f"{number(estimate.low)} to {number(estimate.high)}"


def _availability_rows(measurement: NetworkMeasurement, suffix: str) -> Iterator[tuple[str, str, str]]:
    """Yield rows for the trace, with intervals, and for the preferred model."""
    observed = measurement.observed_availability
    yield "in the trace", f"{counted(observed.messages, 'message')}", ""
    value, low, high = observed.availability
    interval = "" if low is None or high is None else f"{_available(low)} to {_available(high)}"
    yield "  availability", _available(value), interval or "not known: no failure to measure"
    yield "  failures", str(observed.failures), ""
    value, low, high = observed.mean_time_between_failures_s
    shown = long_duration(value) if observed.failures else "no failure"
    until = "" if high is None else f" to {long_duration(high)}"
    yield "  mean time between failures", shown, f"{'from ' * (not until)}{long_duration(low or 0.0)}{until}"
    predicted, fit = measurement.predicted_availability, measurement.availability_model
    if predicted is None or fit is None:
        return
    yield f"by the preferred model ({_MODELS[fit.model]}){suffix}", "", ""
    yield "  availability", availability_percent(predicted.unavailability), "exact for the model"
    yield "  mean time between failures", long_duration(predicted.mean_time_between_failures_s), ""


def _available(share: float) -> str:
    return availability_percent(1 - share)


def _outage_rows(measurement: NetworkMeasurement) -> Iterator[tuple[str, str, str]]:
    fit = measurement.outage_fit
    per_hour = fit.rate_per_s and IntervalEstimate(*(3600 * value for value in fit.rate_per_s))
    yield "outages per hour", *_estimate(per_hour)
    if fit.count:
        yield "mean duration in s", *_estimate(fit.duration_s)
        yield "fit", fit.text, ""


def _void_rows(void: CertificateTime) -> Iterator[tuple[str, str, str, str]]:
    for violation in void.causes:
        yield violation.cause, percent(violation.share), f"{violation.first_s:.3f} s", violation.text
    for cause, text in void.kept.items():
        yield cause, percent(0.0), NONE, text
    first_violated = NONE if void.first_s is None else f"{void.first_s:.3f} s"
    yield "any of them", percent(void.share), first_violated, ""


def void_remarks(void: CertificateTime | None) -> Iterator[str]:
    """Yield the remarks about a scenario's certificate."""
    if void is None:
        return
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
