"""``noack measure``: losses, delays and the M of a real network."""

import re
from decimal import Decimal
from enum import StrEnum
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from cosim.cli import command as cli
from cosim.cli import options as opt
from cosim.lazy_modules import lazy_modules
from noack.core.errors import CallerError

with lazy_modules():
    from cosim.measurement import loss_bursts, measurement_outputs, network_measurement, trace_sources
    from noack.core import clock
    from noack.impairments import words
    from noack.traces import packet_trace

_RATE = re.compile(r"([0-9]+(?:\.[0-9]+)?)(k?)(?:hz)?", re.IGNORECASE)
_SHORTEST_PERIOD_NS, _LONGEST_PERIOD_NS = 50_000, 3600 * 10**9
"""Periods of 20 kHz and 0.001 Hz."""


class NetworkForm(StrEnum):
    """How a measured network is written."""

    TRACE = "trace"
    MODEL = "model"


class ClockRelation(StrEnum):
    """Whether sending and receiving times are comparable."""

    SAME = "same"
    DIFFERENT = "different"


@opt.option_group
class FileOptions:
    """How files are read.

    Options:
        flow: Flow of a capture or a fate file; 1 is the largest.
        sequence_at: Where the payloads of a capture of the receiver's end have sequence numbers.
        clocks: Whether both times of a file were read on the same clock.
        rate: Packets of the simulated probe through delivery opportunities.
    """

    flow: Annotated[int, Option(min=1)] = 1
    sequence_at: Annotated[str | None, Option(metavar="OFFSET:BYTES[:little]")] = None
    clocks: ClockRelation | None = None
    rate: Annotated[str, Option(metavar="RATE")] = "50hz"

    def source(self) -> "trace_sources.SourceOptions":
        """Return how a source is read."""
        differ = None if self.clocks is None else self.clocks is ClockRelation.DIFFERENT
        return trace_sources.SourceOptions(differ, self.flow, self.sequence_at, _period_ns(self.rate))


@opt.option_group
class LossOptions:
    """What counts as lost, and what is computed.

    Options:
        deadline: Packets that take longer count as lost, e.g. 100ms.
        share: Share of loss bursts and packets for which M is given, e.g. 99%; repeatable.
        window: K of the (m, K) table; repeatable.
        outage: Loss bursts of this duration or more are outages; by default a test decides.
    """

    deadline: Annotated[str | None, Option(metavar="TIME")] = None
    share: Annotated[list[str] | None, Option(metavar="SHARE")] = None
    window: Annotated[list[int] | None, Option(min=1, max=100_000_000)] = None
    outage: Annotated[str | None, Option(metavar="TIME")] = None

    def measurement(self) -> "network_measurement.MeasurementOptions":
        """Return the options of a measurement; raise CallerError if one is wrong."""
        shares = tuple(map(_share, self.share or ())) or network_measurement.QUANTILES
        windows = tuple(sorted(set(self.window or loss_bursts.WINDOWS)))
        deadline_s, outage_s = (
            None if text is None else _time_s(option, text)
            for option, text in (("--deadline", self.deadline), ("--outage", self.outage))
        )
        return network_measurement.MeasurementOptions(deadline_s, shares, windows, outage_s)


@opt.option_group
class WrittenOptions(opt.FigureOptions):
    """What is compared and written.

    Options:
        for_scenario: Report for which share of the time its certificate would have been void.
        out: Write a page with tables and figures (.html).
        write: Write a [network] section that reproduces the network (.toml).
        form: Write the network as the trace itself, or as a fitted model.
    """

    for_scenario: Annotated[str | None, Option(metavar="SCENARIO", autocompletion=opt.complete_scenarios)] = (
        None
    )
    settings: opt.SetOption = None
    out: opt.OutOption = None
    write: Annotated[Path | None, Option(callback=opt.usable_path)] = None
    form: Annotated[NetworkForm, Option("--as")] = NetworkForm.TRACE

    def request(self) -> "measurement_outputs.OutputRequest":
        """Return what is written; raise CallerError if an option is wrong."""
        if self.settings and self.for_scenario is None:
            raise CallerError("--set: replaces a value of the scenario of --for-scenario; give one")
        scenario = self.for_scenario and opt.load_scenario(self.for_scenario, self.settings)
        if self.form is NetworkForm.MODEL and self.write is None:
            raise CallerError("--as model: is the form of --write; give its FILE.toml")
        return measurement_outputs.OutputRequest(
            self.out, self.files, self.write, self.form.value, scenario or None
        )


@cli.command(cli.MEASURING, 10, takes="some seconds")
def measure(
    sources: Annotated[list[str], Argument(metavar="FILE")],
    *,
    files: FileOptions,
    losses: LossOptions,
    written: WrittenOptions,
    json: opt.JsonOption = False,
) -> None:
    """Measure a network: losses, bursts, M, delays, outages, and models that fit.

    Options:
        sources: A packet trace, the name of a shipped one, JSON of irtt, captures of both ends, a
            fate file, a run directory, or delivery opportunities.

    Examples:
        noack measure rural_n8_10kmh --deadline 100ms   a recorded trace
        noack measure rural_n8_10kmh --deadline 100ms --out measured.html   with a page of figures
        noack measure rural_n8_10kmh --for-scenario lane_following   when its certificate is void
        noack measure sent.json   round trips that `irtt client -o sent.json` has measured
        noack measure sender.pcap receiver.pcap   captures of both ends
        noack measure rural_n8_10kmh --write network.toml   the network for a scenario file
    """
    options, request = losses.measurement(), written.request()
    trace = trace_sources.read_source([*map(packet_trace.find_trace, sources)], files.source())
    name = " ".join(sources)
    measurement = network_measurement.NetworkMeasurement(trace, options, name, trace.notes)
    document = measurement_outputs.report(measurement, request, None if json else cli.console())
    if json:
        cli.print_json(document)


def _period_ns(rate: str) -> int:
    """Return the period of a rate such as ``50hz`` or ``2khz``."""
    match = _RATE.fullmatch(rate)
    per_s = Decimal(match[1]) * (1000 if match[2] else 1) if match else Decimal(0)
    period_ns = int((clock.NS_PER_S / per_s).to_integral_value()) if per_s else 0
    if not _SHORTEST_PERIOD_NS <= period_ns <= _LONGEST_PERIOD_NS:
        raise CallerError(f"--rate {rate}: expected a rate from 0.001hz to 20khz, e.g. 50hz")
    return period_ns


def _time_s(option: str, text: str) -> float:
    """Return a positive time such as ``60s``."""
    expected = words.OWN_TIME_S
    try:
        time_s = expected.read(text)
        if not 0 < time_s <= 10**8:
            raise ValueError
    except ValueError:
        raise CallerError(f"{option} {text}: expected {expected.expected}") from None
    return time_s


def _share(text: str) -> float:
    percent = text.endswith("%")
    try:
        share = float(text.removesuffix("%")) / (100 if percent else 1)
    except ValueError:
        share = 0.0
    if not 0 < share <= 1:
        raise CallerError(f"--share {text}: expected a share, e.g. 0.99 or 99%")
    return share
