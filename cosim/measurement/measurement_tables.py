"""The tables of a measurement, as text: for the terminal and for the page."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cosim.measurement.certificate_time import CertificateTime
from cosim.measurement.loss_bursts import Estimate, histogram
from cosim.measurement.network_measurement import Measurement
from noack.core.number_format import NONE, duration, number, percent

_MODELS = {
    "bernoulli": "independent losses",
    "gilbert": "Gilbert",
    "gilbert_elliott": "Gilbert–Elliott",
}
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


@dataclass(frozen=True)
class TextTable:
    """A table whose first column is its rows' names."""

    title: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]


def measurement_tables(
    found: Measurement, void: CertificateTime | None = None
) -> Iterator[TextTable]:
    """Yield the tables of a measurement, and that of a scenario's certificate."""
    yield TextTable("losses and delays", ("quantity", "value"), [*_numbers(found)])
    yield TextTable(
        "M: at most M − 1 consecutive losses" + _without(found),
        ("share", "of the bursts", "with 95 % confidence", "of the packets"),
        [
            (percent_of(one.share), str(one.bursts), _or_few(one.bursts_confident),
             str(one.packets))
            for one in found.quantiles
        ],
    )  # fmt: skip
    if found.windows:
        columns = 3 if found.is_outage.any() else 2
        yield TextTable(
            "(m, K): most losses m in any K consecutive packets",
            ("K", "m", "m in windows without an outage")[:columns],
            [
                (str(window), str(every), NONE if usual is None else str(usual))[:columns]
                for window, (every, usual) in found.windows.items()
            ],
        )
    if found.models:
        yield TextTable(
            "loss models" + _without(found),
            ("model and parameter", "estimate", "95 % interval"),
            [*_model_rows(found)],
        )
    yield TextTable(
        "model of the outages", ("parameter", "estimate", "95 % interval"), [*_outage_rows(found)]
    )
    if void is not None:
        yield TextTable(
            f"{void.scenario}: when the network violates a condition of its certificates",
            ("condition", "share of the time", "first", "worst"),
            [*_void_rows(void)],
        )


def print_measurement(
    console: Console, found: Measurement, void: CertificateTime | None = None
) -> None:
    """Print the tables and the remarks."""
    console.print(found.name, markup=False, highlight=False, soft_wrap=True)
    for table in measurement_tables(found, void):
        console.print(f"\n[bold]{escape(table.title)}[/]", highlight=False)
        shown = Table()
        for place, heading in enumerate(table.headings):
            shown.add_column(escape(heading), justify="right" if place else "left")
        for row in table.rows:
            shown.add_row(*map(escape, row))
        console.print(shown)
    for line in (*found.remarks, *void_remarks(void)):
        console.print(line, markup=False, highlight=False)


def percent_of(share: float) -> str:
    """Write a share given by the user: 0.999 is 99.9 %."""
    return f"{100 * share:.6g} %"


def _numbers(found: Measurement) -> Iterator[tuple[str, str]]:
    count, deadline_s = len(found.trace), found.options.deadline_s
    yield "packets", f"{count} in {found.observed_s:.1f} s"
    yield "lost", _share(int(found.outcomes.lost.sum()), count)
    yield "out of order (stale)", _share(int(found.outcomes.out_of_order.sum()), count)
    if deadline_s is not None:
        name = f"later than the deadline of {duration(deadline_s)}"
        yield name, _share(int(found.outcomes.late.sum()), count)
    yield "effective losses (all of these)", _share(found.bursts.losses, count)
    bursts = found.bursts
    if len(bursts.length):
        listed = [f"{count} × {length}" for length, count in histogram(bursts).items()]
        if len(listed) > _MOST_LISTED:
            listed[_MOST_LISTED // 2 : -_MOST_LISTED // 2] = ["…"]
        yield "loss bursts (number × length)", ", ".join(listed)
        yield "longest loss burst", _burst(found, int(np.argmax(bursts.length)))
        outages = np.flatnonzero(found.is_outage).tolist()
        yield "outages", str(len(outages)) if outages else f"none: {found.outage_rule.reason}"
        for place in outages[:_MOST_OUTAGES]:
            yield "  outage", _burst(found, place)
        if outages:
            yield "  rule", found.outage_rule.reason
    longest = found.longest_loss_burst
    yield "M" + _without(found), f"{longest + 1} (maximum consecutive losses M − 1: {longest})"
    if (fewest := found.fewest_deliveries) is not None:
        yield "fewest deliveries between two bursts", str(fewest)
    delays = found.delays
    if delays.received:
        values = (duration(delays.quantiles_s[share]) for share in _SHOWN_DELAYS)
        yield f"delay {' / '.join(_SHOWN_DELAYS.values())}", " / ".join(values)
    if delays.correlation:
        yield "correlation of successive delays", f"{delays.correlation[0]:.2f}"


def _without(found: Measurement) -> str:
    return ", without the outages" if found.is_outage.any() else ""


def _share(part: int, of: int) -> str:
    return f"{part} ({percent(part / of)})" if part else "0"


def _burst(found: Measurement, place: int) -> str:
    one = found.burst_json(place)
    return f"{one['losses']} packets, {one['duration_s']:.3g} s, from {one['begin_s']:.3f} s"


def _or_few(value: int | None) -> str:
    return "too few bursts" if value is None else str(value)


def _model_rows(found: Measurement) -> Iterator[tuple[str, str, str]]:
    for name, model in found.models.items():
        chosen = " (preferred)" if name == found.chosen.fit.model else ""
        yield f"{_MODELS[name]}{chosen}", "", ""
        for parameter, estimate in model.fit.estimates.items():
            yield f"  {_PARAMETERS[parameter]}", *_estimate(estimate)
        yield "  mean loss rate", number(model.fit.rates.loss_rate), ""
        yield "  fit", model.test.verdict, model.test.figures


def _estimate(estimate: Estimate | None, digits: int = 3) -> tuple[str, str]:
    if estimate is None:
        return "not determined", ""
    low, high = number(estimate.low, digits), number(estimate.high, digits)
    return number(estimate.value, digits), f"{low} to {high}"


def _outage_rows(found: Measurement) -> Iterator[tuple[str, str, str]]:
    fit = found.outage_fit
    per_hour = fit.rate_per_s and Estimate(*(3600 * value for value in fit.rate_per_s))
    yield "outages per hour", *_estimate(per_hour)
    if fit.count:
        yield "mean duration in s", *_estimate(fit.duration_s)
        yield "fit", fit.text, ""


def _void_rows(void: CertificateTime) -> Iterator[tuple[str, str, str, str]]:
    for one in void.causes:
        yield one.cause, percent(one.share), f"{one.first_s:.3f} s", one.text
    for cause, text in void.kept.items():
        yield cause, percent(0.0), NONE, text
    first = NONE if void.first_s is None else f"{void.first_s:.3f} s"
    yield "any of them", percent(void.share), first, ""


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
