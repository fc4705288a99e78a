"""``noack measure``: losses, delays and the M of a real network."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from cosim.cli import command as cli
from cosim.cli import completion
from noack.core.errors import CallerError, ExitStatus

if TYPE_CHECKING:
    from cosim.measurement.live.live_measurement import LiveOptions
    from cosim.measurement.live.probe_ends import ProbeResult
    from cosim.measurement.network_measurement import MeasurementOptions
    from cosim.measurement.trace_sources import SourceOptions

_TRACE = "rural_n8_10kmh"


class NetworkForm(StrEnum):
    """How a measured network is written."""

    TRACE = "trace"
    MODEL = "model"


class ClockRelation(StrEnum):
    """Whether sending and receiving times are comparable."""

    SAME = "same"
    DIFFERENT = "different"


@cli.command(cli.MEASURING, 10, [
    (f"noack measure {_TRACE} --deadline 100ms", "a recorded trace"),
    (f"noack measure {_TRACE} --deadline 100ms --out measured.html", "with a page of figures"),
    (f"noack measure {_TRACE} --for-scenario lane_following", "when its certificate would be void"),
    ("noack measure --listen 0.0.0.0:9100", "receive a probe, on one host"),
    ("noack measure 192.0.2.7:9100 --rate 50hz --for 60s", "send it, on the other host"),
    ("noack measure sender.pcap receiver.pcap", "captures of both ends"),
    (f"noack measure {_TRACE} --write network.toml", "the network for a scenario file"),
])  # fmt: skip
def measure(
    sources: Annotated[list[str] | None, Argument(metavar="FILE...|ADDRESS")] = None,
    *,
    listen: Annotated[str | None, Option(metavar="ADDRESS")] = None,
    rate: Annotated[str, Option(metavar="RATE")] = "50hz",
    duration: Annotated[str, Option("--for", metavar="TIME")] = "60s",
    size: Annotated[int, Option(metavar="BYTES")] = 128,
    round_trip: Annotated[bool, Option("--round-trip")] = False,
    silence: Annotated[str, Option(metavar="TIME")] = "30s",
    save: Path | None = None,
    flow: Annotated[int, Option(min=1)] = 1,
    sequence_at: Annotated[str | None, Option(metavar="OFFSET:BYTES[:little]")] = None,
    clocks: ClockRelation | None = None,
    deadline: Annotated[str | None, Option(metavar="TIME")] = None,
    share: Annotated[list[str] | None, Option(metavar="SHARE")] = None,
    window: Annotated[list[int] | None, Option(min=1, max=100_000_000)] = None,
    outage: Annotated[str | None, Option(metavar="TIME")] = None,
    for_scenario: Annotated[
        str | None, Option(metavar="SCENARIO", autocompletion=completion.scenarios)
    ] = None,
    settings: cli.SetOption = None,
    out: cli.OutOption = None,
    figure_format: cli.FormatOption = None,
    width: cli.WidthOption = None,
    write: Path | None = None,
    form: Annotated[NetworkForm, Option("--as")] = NetworkForm.TRACE,
    json: cli.JsonOption = False,
) -> int:
    """Measure a network: losses, bursts, M, delays, outages, and models that fit.

    Options:
        sources: A packet trace, the name of a shipped one, captures of both ends, a fate file, a
            run directory, delivery opportunities; or the address of a listener, to which a probe
            is sent.
        listen: Receive one probe there, e.g. 0.0.0.0:9100.
        rate: Datagrams of the probe.
        duration: Duration of the probe.
        size: Size of the probe's datagrams, at least 100.
        round_trip: The listener sends each datagram back.
        silence: Once a probe has begun, a listener ends after so long without a datagram. It waits
            for a probe until Ctrl-C.
        save: Write the raw trace to this file while probing (.csv).
        flow: Flow of a capture or a fate file; 1 is the largest.
        sequence_at: Where the payloads of a capture of the receiver's end have sequence numbers.
        clocks: Whether both times of a file were read on the same clock.
        deadline: Packets that take longer count as lost, e.g. 100ms.
        share: Share of loss bursts and packets for which M is given, e.g. 99%; repeatable.
        window: K of the (m, K) table; repeatable.
        outage: Loss bursts of this duration or more are outages; by default a test decides.
        for_scenario: Report for which share of the time its certificate would have been void.
        out: Write a page with tables and figures (.html).
        write: Write a [network] section that reproduces the network (.toml).
        form: Write the network as the trace itself, or as a fitted model.
    """
    from rich.console import Console

    from cosim.measurement.live.live_measurement import LiveOptions, period_ns_of
    from cosim.measurement.measurement_outputs import OutputRequest, report
    from cosim.measurement.network_measurement import Measurement, MeasurementOptions
    from cosim.measurement.trace_sources import SourceOptions
    from cosim.output.figure_format import figure_files

    options = _options(deadline, share, window, outage)
    if settings and for_scenario is None:
        raise CallerError("--set: replaces a value of the scenario of --for-scenario; give one")
    scenario = None if for_scenario is None else cli.load_scenario(for_scenario, settings)
    if form is NetworkForm.MODEL and write is None:
        raise CallerError("--as model: is the form of --write; give its FILE.toml")
    files_of_figures = figure_files(figure_format, width)
    request = OutputRequest(out, files_of_figures, write, form.value, scenario)
    live = LiveOptions(rate, duration, size, round_trip, silence, save, options.deadline_s)
    how = SourceOptions(
        None if clocks is None else clocks is ClockRelation.DIFFERENT,
        flow, sequence_at, period_ns_of(rate),
    )  # fmt: skip
    if _is_one_way_sender(sources, listen, live) and (
        options != MeasurementOptions(deadline_s=options.deadline_s) or request != OutputRequest()
    ):
        raise CallerError(
            "the sender of a one-way probe does not know what arrives: give the options of the "
            "measurement to the listener, or add --round-trip"
        )
    result, name = _result(sources or [], listen, live, how)
    if result.trace is None:  # the sender of a one-way probe does not know what arrived
        if json:
            cli.print_json({"notes": result.notes})
        else:
            print(*result.notes, "the listener reports what has arrived", sep="\n")
        return ExitStatus.OK
    found = Measurement(result.trace, options, name, result.notes)
    document = report(found, request, None if json else Console())
    if json:
        cli.print_json(document)
    return ExitStatus.UNINTENDED_LOSSES if result.kernel_drops else ExitStatus.OK


def _result(
    sources: list[str], listen: str | None, live: "LiveOptions", how: "SourceOptions"
) -> tuple["ProbeResult", str]:
    """Return the result of a probe or of reading files, and a name for it."""
    from cosim.measurement.live.live_measurement import (
        LIVE_OPTIONS,
        is_address,
        receive_live,
        send_live,
    )
    from cosim.measurement.live.probe_ends import ProbeResult
    from cosim.measurement.trace_sources import FILE_OPTIONS, read_source, refuse_unused
    from noack.traces.trace_formats import find_trace

    if listen is not None:
        if sources:
            raise CallerError(f"--listen {listen}: receives a probe, and reads no {sources[0]}")
        refuse_unused(live, LIVE_OPTIONS, "a listener; the sender has it", "silence", "save")
        refuse_unused(how, FILE_OPTIONS, "a live probe", "period_ns")
        return receive_live(listen, live), f"probe received at {listen}"
    if not sources:
        raise CallerError("expected a file, the address of a listener, or --listen ADDRESS")
    if len(sources) == 1 and is_address(sources[0]):
        refuse_unused(live, {"silence": "--silence"}, "a sender; the listener has it")
        refuse_unused(how, FILE_OPTIONS, "a live probe", "period_ns")
        return send_live(sources[0], live), f"probe of {sources[0]}"
    refuse_unused(live, LIVE_OPTIONS, f"{sources[0]}, which is no address of a listener", "rate")
    trace = read_source([*map(find_trace, sources)], how)
    return ProbeResult(trace, trace.notes, None), " ".join(sources)


def _is_one_way_sender(sources: list[str] | None, listen: str | None, live: "LiveOptions") -> bool:
    from cosim.measurement.live.live_measurement import is_address

    is_probe = sources is not None and len(sources) == 1 and is_address(sources[0])
    return is_probe and listen is None and not live.round_trip


def _share(text: str) -> float:
    percent = text.endswith("%")
    try:
        share = float(text.removesuffix("%")) / (100 if percent else 1)
    except ValueError:
        share = 0.0
    if not 0 < share <= 1:
        raise CallerError(f"--share {text}: expected a share, e.g. 0.99 or 99%")
    return share


def _options(
    deadline: str | None, shares: list[str] | None, window: list[int] | None, outage: str | None
) -> "MeasurementOptions":
    from cosim.measurement.live.live_measurement import time_s_of
    from cosim.measurement.loss_bursts import WINDOWS
    from cosim.measurement.network_measurement import QUANTILES, MeasurementOptions

    return MeasurementOptions(
        deadline_s=None if deadline is None else time_s_of("--deadline", deadline),
        quantiles=tuple(map(_share, shares)) if shares else QUANTILES,
        windows=tuple(sorted(set(window or WINDOWS))),
        outage_s=None if outage is None else time_s_of("--outage", outage),
    )
