"""``noack measure``: losses, delays and the M of a real network."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from cosim.cli import command as cli
from cosim.cli import options as opt
from cosim.lazy_modules import lazy_modules
from noack.core.errors import CallerError, ExitStatus

with lazy_modules():
    from cosim.measurement import (
        live_measurement,
        loss_bursts,
        measurement_outputs,
        network_measurement,
        probe_ends,
        trace_sources,
    )
    from noack.core import core_library
    from noack.traces import packet_trace


class NetworkForm(StrEnum):
    """How a measured network is written."""

    TRACE = "trace"
    MODEL = "model"


class ClockRelation(StrEnum):
    """Whether sending and receiving times are comparable."""

    SAME = "same"
    DIFFERENT = "different"


@opt.option_group
class ProbeOptions:
    """A probe, and who sends or receives it.

    Options:
        listen: Receive one probe there, e.g. 0.0.0.0:9100.
        rate: Datagrams of the probe.
        duration: Duration of the probe.
        size: Size of the probe's datagrams, at least 100.
        round_trip: The listener sends each datagram back.
        silence: Once a probe has begun, a listener ends after this time without a datagram. It waits
            for a probe until Ctrl-C.
        save: Write the raw trace to this file while probing (.csv).
    """

    listen: Annotated[str | None, Option(metavar="ADDRESS")] = None
    rate: Annotated[str, Option(metavar="RATE")] = "50hz"
    duration: Annotated[str, Option("--for", metavar="TIME")] = "60s"
    size: Annotated[int, Option(metavar="BYTES")] = 128
    round_trip: Annotated[bool, Option("--round-trip")] = False
    silence: Annotated[str, Option(metavar="TIME")] = "30s"
    save: Path | None = None

    def live(self, deadline_s: float | None) -> "live_measurement.LiveProbeOptions":
        """Return the options of a live measurement."""
        return live_measurement.LiveProbeOptions(
            self.rate, self.duration, self.size, self.round_trip, self.silence, self.save, deadline_s
        )


@opt.option_group
class FileOptions:
    """How files are read.

    Options:
        flow: Flow of a capture or a fate file; 1 is the largest.
        sequence_at: Where the payloads of a capture of the receiver's end have sequence numbers.
        clocks: Whether both times of a file were read on the same clock.
    """

    flow: Annotated[int, Option(min=1)] = 1
    sequence_at: Annotated[str | None, Option(metavar="OFFSET:BYTES[:little]")] = None
    clocks: ClockRelation | None = None

    def source(self, rate: str) -> "trace_sources.SourceOptions":
        """Return how a source is read, with the rate of a probe through it."""
        differ = None if self.clocks is None else self.clocks is ClockRelation.DIFFERENT
        period_ns = live_measurement.period_ns_of(rate)
        return trace_sources.SourceOptions(differ, self.flow, self.sequence_at, period_ns)


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
            None if text is None else live_measurement.time_s_of(option, text)
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


@cli.command(cli.MEASURING, 10, takes="some seconds for a file; a probe, as long as --for")
def measure(
    sources: Annotated[list[str] | None, Argument(metavar="FILE...|ADDRESS")] = None,
    *,
    probe: ProbeOptions,
    files: FileOptions,
    losses: LossOptions,
    written: WrittenOptions,
    json: opt.JsonOption = False,
) -> int:
    """Measure a network: losses, bursts, M, delays, outages, and models that fit.

    Options:
        sources: A packet trace, the name of a shipped one, captures of both ends, a fate file, a
            run directory, delivery opportunities; or the address of a listener, to which a probe
            is sent.

    Examples:
        noack measure rural_n8_10kmh --deadline 100ms   a recorded trace
        noack measure rural_n8_10kmh --deadline 100ms --out measured.html   with a page of figures
        noack measure rural_n8_10kmh --for-scenario lane_following   when its certificate is void
        noack measure --listen 0.0.0.0:9100   receive a probe, on one host
        noack measure 192.0.2.7:9100 --rate 50hz --for 60s   send it, on the other host
        noack measure sender.pcap receiver.pcap   captures of both ends
        noack measure rural_n8_10kmh --write network.toml   the network for a scenario file
    """
    options, request = losses.measurement(), written.request()
    is_probe = sources is not None and len(sources) == 1 and live_measurement.is_address(sources[0])
    if (
        is_probe
        and probe.listen is None
        and not probe.round_trip
        and (
            options != network_measurement.MeasurementOptions(deadline_s=options.deadline_s)
            or request != measurement_outputs.OutputRequest()
        )
    ):
        raise CallerError(
            "the sender of a one-way probe does not know what arrives: give the options of the "
            "measurement to the listener, or add --round-trip"
        )
    live, how = probe.live(options.deadline_s), files.source(probe.rate)
    result, name = _result(sources or [], probe.listen, live, how)
    if result.trace is None:  # the sender of a one-way probe does not know what arrived
        last = "the listener reports what has arrived"
        cli.print_lines(json, {"notes": result.notes}, *result.notes, last)
        return ExitStatus.OK
    measurement = network_measurement.NetworkMeasurement(result.trace, options, name, result.notes)
    document = measurement_outputs.report(measurement, request, None if json else cli.console())
    if json:
        cli.print_json(document)
    return ExitStatus.UNINTENDED_LOSSES if result.kernel_drops else ExitStatus.OK


def _result(
    sources: list[str],
    listen: str | None,
    live: "live_measurement.LiveProbeOptions",
    how: "trace_sources.SourceOptions",
) -> tuple["probe_ends.ProbeResult", str]:
    """Return the result of a probe or of reading files, and a name for it."""
    if listen is not None or (sources and live_measurement.is_address(sources[0])):
        core_library.require_live_runs()
    refuse, options = trace_sources.refuse_unused, live_measurement.LIVE_OPTIONS
    if listen is not None:
        if sources:
            raise CallerError(f"--listen {listen}: receives a probe, and reads no {sources[0]}")
        refuse(live, options, "a listener; the sender has it", "silence", "save")
        refuse(how, trace_sources.FILE_OPTIONS, "a live probe", "period_ns")
        return live_measurement.receive_live(listen, live), f"probe received at {listen}"
    if not sources:
        raise CallerError("expected a file, the address of a listener, or --listen ADDRESS")
    if len(sources) == 1 and live_measurement.is_address(sources[0]):
        refuse(live, {"silence": "--silence"}, "a sender; the listener has it")
        refuse(how, trace_sources.FILE_OPTIONS, "a live probe", "period_ns")
        return live_measurement.send_live(sources[0], live), f"probe of {sources[0]}"
    refuse(live, options, f"{sources[0]}, which is not the address of a listener", "rate")
    trace = trace_sources.read_source([*map(packet_trace.find_trace, sources)], how)
    return probe_ends.ProbeResult(trace, trace.notes, None), " ".join(sources)


def _share(text: str) -> float:
    percent = text.endswith("%")
    try:
        share = float(text.removesuffix("%")) / (100 if percent else 1)
    except ValueError:
        share = 0.0
    if not 0 < share <= 1:
        raise CallerError(f"--share {text}: expected a share, e.g. 0.99 or 99%")
    return share
