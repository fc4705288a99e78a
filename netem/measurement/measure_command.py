"""The command ``noack-netem measure``: losses, bursts and delays of a network, from files.

noack's own command, ``noack measure``, has pages, figures and comparisons with scenarios in addition.
"""

import argparse
from collections.abc import Sequence

from netem.core.command_line import Parser
from netem.core.console import SafeConsole
from netem.core.errors import ExitStatus
from netem.measurement.measure_arguments import MeasureArguments, measure_sources
from netem.measurement.measured_preset import preset_path, write_preset
from netem.measurement.measurement_document import measurement_document
from netem.output.document import Document
from netem.output.json_writer import print_json
from netem.output.terminal_writer import print_document

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
    given = vars(_parser().parse_args(arguments))
    as_json: bool = given.pop("json")
    name: str | None = given.pop("preset")
    preset = None if name is None else preset_path(name)
    measured = measure_sources(MeasureArguments(**given), {"--preset": name})
    if isinstance(measured, Document):
        return _print(measured, as_json=as_json)
    _print(measurement_document(measured), as_json=as_json)
    if preset is not None:
        written = write_preset(measured, preset)
        if not as_json:
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
