"""``noack measure``: losses and delays of a real network."""

from contextlib import nullcontext
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from cosim.cli import options as opt
from cosim.cli.options import MEASURING, examples
from cosim.cli.printing import show, status
from cosim.output.figures.figure_format import requested_files
from netem.core.errors import CallerError

app = typer.Typer()


class NetworkForm(StrEnum):
    """How a measured network is written."""

    TRACE = "trace"
    MODEL = "model"


class ClockRelation(StrEnum):
    """Whether sending and receiving times are comparable."""

    SAME = "same"
    DIFFERENT = "different"


@app.command(
    rich_help_panel=MEASURING,
    epilog=examples(
        ("noack measure rural_n8_10kmh --deadline 100ms", "a recorded trace"),
        (
            "noack measure rural_n8_10kmh --deadline 100ms --out measured.html",
            "with a page of figures",
        ),
        (
            "noack measure rural_n8_10kmh --for lane_following",
            "when its certificate is void",
        ),
        (
            "noack measure urban_n78_40kmh --deadline 100ms --survival 120ms",
            "availability for a survival time",
        ),
        ("noack measure sent.json", "round trips that `irtt client -o sent.json` has measured"),
        ("noack measure sender.pcap receiver.pcap", "captures of both ends"),
        ("noack measure capture.pcap --preset office", "for noack netem ... like ./office.toml"),
        (
            "noack measure rural_n8_10kmh --write network.toml",
            "the network for a scenario file",
        ),
    ),
)
def measure(
    sources: Annotated[
        list[str],
        Argument(
            metavar="FILE",
            help="A packet trace, the name of a shipped one, JSON of irtt or iperf3, a log of ping or "
            "fping, captures of both ends, a run directory, or delivery opportunities.",
        ),
    ],
    flow: Annotated[int, Option(help="Flow of a capture; 1 is the largest.")] = 1,
    flows: Annotated[
        bool, Option("--flows", help="Measure all flows of a capture, a row each, the worst first.")
    ] = False,
    far_flow: Annotated[
        int | None,
        Option(
            help="Flow to compare with; by default the one in which the datagrams are seen soonest.",
        ),
    ] = None,
    sequence_at: Annotated[
        str | None,
        Option(
            metavar="OFFSET:BYTES[:little]",
            help="Where the payloads of a capture of the receiver's end have sequence numbers.",
        ),
    ] = None,
    bits: Annotated[
        int | None,
        Option(metavar="N", help="The sequence number is in the lowest N bits of --sequence-at."),
    ] = None,
    numbers: Annotated[
        str | None,
        Option(metavar="FIRST..LAST", help="Range of the sequence numbers, e.g. 1..255."),
    ] = None,
    clocks: Annotated[
        ClockRelation | None,
        Option(help="Whether sending and receiving times were read on the same clock."),
    ] = None,
    rate: Annotated[
        str,
        Option(metavar="RATE", help="Packets of the simulated probe through delivery opportunities."),
    ] = "50hz",
    deadline: Annotated[
        str | None,
        Option(metavar="TIME", help="Packets that take longer count as lost, e.g. 100ms."),
    ] = None,
    share: Annotated[
        list[str] | None,
        Option(
            metavar="SHARE",
            help="Share of bursts and packets for which the losses in a row are given, e.g. 99%; repeatable.",
        ),
    ] = None,
    window: Annotated[
        list[int] | None,
        Option(help="K of the (m, K) table; repeatable."),
    ] = None,
    outage: Annotated[
        str | None,
        Option(
            metavar="TIME",
            help="Loss bursts of this duration or more are outages; by default a test decides.",
        ),
    ] = None,
    within: Annotated[
        str,
        Option(metavar="N|TIME", help="Chance of a long loss burst within N packets, or within a time."),
    ] = "1000",
    interval: Annotated[
        str | None,
        Option(metavar="TIME", help="Transfer interval of a service; by default the packets' period."),
    ] = None,
    survival: Annotated[
        str | None,
        Option(
            metavar="TIME",
            help="Availability of a service that goes on for TIME after a lost message (survival time).",
        ),
    ] = None,
    for_scenario: Annotated[
        str | None,
        Option(
            "--for",
            metavar="SCENARIO",
            autocompletion=opt.complete_scenarios,
            help="Report for which share of the time its certificate would have been void, and whether "
            "it is certified on this network.",
        ),
    ] = None,
    settings: opt.SetOption = None,
    out: Annotated[
        Path | None,
        Option(callback=opt.usable_path, help="Write a page with tables and figures (.html)."),
    ] = None,
    write: Annotated[
        Path | None,
        Option(
            callback=opt.usable_path,
            help="Write a [network] section that reproduces the network (.toml).",
        ),
    ] = None,
    preset: Annotated[
        str | None,
        Option(metavar="NAME", help="Write a preset, NAME.toml, for `noack netem ... like ./NAME.toml`."),
    ] = None,
    form: Annotated[
        NetworkForm,
        Option("--as", help="Write the network as the trace itself, or as a fitted model."),
    ] = NetworkForm.TRACE,
    figure_format: opt.FigureFormatOption = None,
    width: opt.WidthOption = None,
    json: opt.JsonOption = False,
) -> None:
    """Measure a network: losses, bursts, delays, outages, and models that fit.

    Takes some seconds.
    """
    from cosim.measurement.measurement_outputs import OutputRequest, write_outputs
    from cosim.measurement.run_trace import read_source
    from netem.measurement.measure_arguments import MeasureArguments, measure_sources
    from netem.measurement.measured_preset import preset_path
    from netem.output.document import Document

    arguments = MeasureArguments(
        sources=sources,
        flow=flow,
        flows=flows,
        far_flow=far_flow,
        sequence_at=sequence_at,
        bits=bits,
        numbers=numbers,
        clocks=clocks,
        rate=rate,
        deadline=deadline,
        share=share,
        window=window,
        outage=outage,
        within=within,
        interval=interval,
        survival=survival,
    )
    _ = arguments.reading, arguments.options  # a wrong option is reported before a scenario is loaded
    if settings and for_scenario is None:
        raise CallerError("--set: replaces a value of the scenario of --for; give one")
    scenario = None if for_scenario is None else opt.load_scenario(for_scenario, settings)
    if form is NetworkForm.MODEL and write is None:
        raise CallerError("--as model: is the form of --write; give its FILE.toml")
    preset_file = None if preset is None else preset_path(preset)
    request = OutputRequest(
        out, requested_files(figure_format, width), write, form.value, scenario, preset_file
    )
    of_one_flow = {"--for": for_scenario, "--out": out, "--write": write, "--preset": preset}
    with status("measuring") if flows else nullcontext():
        measured = measure_sources(arguments, of_one_flow, read_source)
    if isinstance(measured, Document):
        show(measured, json=json)
        return
    document, written = write_outputs(measured, request)
    show(document, json=json, written=[str(path) for path in written])
    if not json:
        print(*(f"written: {path}" for path in written), sep="\n", end="\n" * bool(written))
