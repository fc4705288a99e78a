"""The command ``noack-netem measure``: losses, bursts and delays of a network, from files.

noack's own command, ``noack measure``, has pages, figures and comparisons with scenarios in addition.
"""

import argparse
from collections.abc import Sequence

from netem.core.command_line import Parser
from netem.core.console import SafeConsole
from netem.core.errors import ExitStatus
from netem.measurement.flow_table import flows_document
from netem.measurement.iperf3_table import iperf3_document
from netem.measurement.loss_bursts import WINDOWS
from netem.measurement.measure_options import period_ns, refuse, share, time_s
from netem.measurement.measured_preset import preset_path, write_preset
from netem.measurement.measurement_document import measurement_document
from netem.measurement.network_measurement import QUANTILES, MeasurementOptions, NetworkMeasurement
from netem.measurement.trace_sources import (
    FILE_OPTIONS,
    SourceOptions,
    is_iperf3_file,
    read_files,
    refuse_unused,
)
from netem.output.document import Document
from netem.output.json_writer import print_json
from netem.output.terminal_writer import print_document
from netem.traces.packet_trace import find_trace

_EXAMPLES = """examples:
  noack-netem measure urban_n78_40kmh --deadline 100ms --survival 120ms
  noack-netem measure ping.txt
  noack-netem measure sender.pcap receiver.pcap
  noack-netem measure capture.pcap --preset office     for noack-netem ... like ./office.toml"""


def measure(arguments: Sequence[str]) -> ExitStatus:
    """Measure what the command line names, and print it.

    Raises:
        NoackError: one line; a file cannot be read, or an option is wrong.
    """
    options = _parser().parse_args(arguments)
    paths = [*map(find_trace, options.sources)]
    preset = None if options.preset is None else preset_path(options.preset)
    differ = None if options.clocks is None else options.clocks == "different"
    reading = SourceOptions(
        differ, options.flow, options.far_flow, options.sequence_at, options.bits, options.numbers,
        period_ns(options.rate),
    )  # fmt: skip
    asked = MeasurementOptions(
        time_s("--deadline", options.deadline),
        tuple(map(share, options.share or ())) or QUANTILES,
        options.window or WINDOWS,
        time_s("--outage", options.outage),
        time_s("--interval", options.interval),
        time_s("--survival", options.survival),
        options.within,
    )
    if len(paths) == 1 and is_iperf3_file(paths[0]):
        needs_packets = ("deadline", "outage", "survival", "share", "window", "preset")
        given = {f"--{name}": getattr(options, name) for name in needs_packets}
        refuse(given, "needs packets; iperf3 counts per interval")
        refuse_unused(reading, FILE_OPTIONS, "a report of iperf3")
        return _print(iperf3_document(paths[0]), as_json=options.json)
    if options.flows:
        refuse({"--preset": preset}, "is of one flow; give --flow N in place of --flows")
        return _print(flows_document(paths, reading, asked), as_json=options.json)
    trace = read_files(paths, reading)
    measurement = NetworkMeasurement(trace, asked, " ".join(options.sources), trace.notes)
    _print(measurement_document(measurement), as_json=options.json)
    if preset is not None:
        written = write_preset(measurement, preset)
        if not options.json:
            print(f"written: {written}")
    return ExitStatus.OK


def _print(document: Document, *, as_json: bool) -> ExitStatus:
    if as_json:
        print_json(document.data)
    else:
        print_document(SafeConsole(), document)
    return ExitStatus.OK


def _parser() -> Parser:
    parser = Parser(
        prog="noack-netem measure",
        description="Measure a network from files: losses, bursts, delays, outages, and models that fit.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    add = parser.add_argument
    sources = (
        "a packet trace, the name of a shipped one, JSON of irtt or iperf3, a log of ping or fping, captures "
        "of both ends, or delivery opportunities"
    )
    add("sources", nargs="+", metavar="FILE", help=sources)
    add("--flow", type=int, default=1, metavar="N", help="flow of a capture; 1 is the largest")
    add("--flows", action="store_true", help="measure all flows of a capture, the worst first")
    add("--far-flow", type=int, metavar="N", help="flow to compare with; by default the nearest in time")
    add("--sequence-at", metavar="OFFSET:BYTES[:little]", help="where payloads have sequence numbers")
    add("--bits", type=int, metavar="N", help="the number is in the lowest N bits of --sequence-at")
    add("--numbers", metavar="FIRST..LAST", help="range of the sequence numbers, e.g. 1..255")
    add("--clocks", choices=("same", "different"), help="whether both ends' times are of one clock")
    add("--rate", default="50hz", help="packets of the simulated probe through delivery opportunities (50hz)")
    add("--deadline", metavar="TIME", help="packets that take longer count as lost, e.g. 100ms")
    add("--share", action="append", help="share of loss bursts for which N is given, e.g. 99%%; repeatable")
    add("--window", type=int, action="append", metavar="K", help="K of the (m, K) table; repeatable")
    add("--outage", metavar="TIME", help="loss bursts of this duration or more are outages")
    add(
        "--within",
        default="1000",
        metavar="N|TIME",
        help="chance of a long loss burst within N packets (1000)",
    )
    add("--interval", metavar="TIME", help="transfer interval of a service, for its availability")
    add("--survival", metavar="TIME", help="survival time of a service, for its availability")
    add("--preset", metavar="NAME", help="write a preset, NAME.toml, for `like ./NAME.toml`")
    add("--json", action="store_true", help="print one JSON document")
    return parser
