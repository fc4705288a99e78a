"""A measured network as a document: its verdict, tables and remarks."""

from collections.abc import Iterable, Iterator, Mapping
from types import MappingProxyType

import numpy as np

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
from netem.measurement.interval_estimates import IntervalEstimate
from netem.measurement.loss_bursts import histogram
from netem.measurement.network_measurement import NetworkMeasurement
from netem.output.document import Block, Document, Sentence, SentenceRole
from netem.output.result_tables import KEY_VALUE, ResultTable

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


def measurement_document(
    measurement: NetworkMeasurement,
    *,
    figures: Iterable[Block] = (),
    tables: Iterable[ResultTable] = (),
    remarks: Iterable[str] = (),
    data: Mapping[str, object] = MappingProxyType({}),
) -> Document:
    """Return tables and remarks of a measurement, with figures before them and more after them."""
    outages, longest = int(measurement.is_outage.sum()), measurement.longest_loss_burst
    also = f", and {outages} outage{'s' * (outages > 1)}" if outages else ""
    where = "Outside the outages, at" if outages else "At"
    lines = (*measurement.remarks, *remarks)
    return Document(
        title=measurement.name,
        kind="network measured",
        data={**measurement.to_json(), **data},
        blocks=[
            Sentence(
                text=f"at most {longest} lost in a row{also}",
                role=SentenceRole.VERDICT,
                lead=f"{measurement.name}:",
            ),
            Sentence(
                text=f"{where} most {longest} packets in a row were not effectively delivered.",
                role=SentenceRole.REMARK,
                is_prose=True,
            ),
            *figures,
            *measurement_tables(measurement),
            *tables,
            *(Sentence(text=line, role=SentenceRole.REMARK, is_prose=True) for line in lines),
        ],
    )


def measurement_tables(measurement: NetworkMeasurement) -> Iterator[ResultTable]:
    """Yield the tables of a measurement."""
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
    yield ResultTable("in_a_row", f"lost in a row, at most{suffix}", heads, rows)
    if prediction := measurement.burst_prediction:
        chances = [
            (str(cap), chance_text(chance), str(measurement.longer_bursts(cap)))
            for cap, chance in prediction.chance.items()
        ]
        model = _MODELS[measurement.chosen.fit.model]
        caption = f"chance of a longer loss burst within {prediction.packets} packets{suffix}"
        heads = ("lost in a row", f"chance, by the preferred model ({model})", "longer bursts in the trace")
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
    yield f"lost in a row, at most{suffix}", str(longest)
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
