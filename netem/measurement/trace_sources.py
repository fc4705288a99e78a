"""Packet traces from all that can be measured.

The sources are files of known formats, and the delivery opportunities of mahimahi. The latter say
when the link could deliver, and nothing about losses. So their trace is that of a simulated probe
through the emulator's link: its delays are those of waiting for the next opportunity.
"""

import re
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from netem.core.clock import NS_PER_S
from netem.core.core_library import core
from netem.core.errors import CallerError, one_line
from netem.core.file_access import open_regular
from netem.core.named_file import NamedFile
from netem.core.number_checks import real_number, whole_number
from netem.impairments.kinds.opportunities import OPPORTUNITY_BYTES, Opportunities
from netem.impairments.link_settings import LinkSettings
from netem.link_state import LinkState
from netem.traces.capture_packets import is_capture
from netem.traces.capture_trace import CaptureFileError, CaptureOptions, read_captures
from netem.traces.captured_flows import Capture
from netem.traces.fping_log import is_fping, read_targets
from netem.traces.iperf3_report import is_iperf3
from netem.traces.numbered_datagrams import SequenceField
from netem.traces.packet_trace import (
    FILE_ERRORS,
    LOST_NS,
    MAX_PACKETS,
    PacketTrace,
    decompressed,
    file_problem,
    is_compressed,
    packet_trace,
    read_trace,
)

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_HEAD_BYTES = 1024
"""Bytes by which a file is recognised."""
USUAL_PERIOD_NS = 20_000_000
_SHORTEST_PERIOD_S, _LONGEST_PERIOD_S = 50e-6, 3600.0
_OPPORTUNITIES = "delivery opportunities"


@dataclass(frozen=True)
class SourceOptions:
    """How to read a source."""

    clocks_differ: bool | None = None
    """Whether sending and receiving times were read on different clocks; None: what is usual for
    the source: only in captures of both ends they were."""
    flow: int = 1
    """Which flow of a capture, by its number of packets; 1 is the largest."""
    far_flow: int | None = None
    """Which flow has the far end of the datagrams; None: the nearest one that has them."""
    sequence_at: str | None = None
    """Where the payloads of a capture have sequence numbers: ``OFFSET:BYTES[:little]``."""
    bits: int | None = None
    """The number is in so many lowest bits there; None: in all."""
    numbers: str | None = None
    """The range of the numbers, ``FIRST..LAST``; None: from 0 on."""
    period_ns: int = USUAL_PERIOD_NS
    """Period of the simulated probe through delivery opportunities."""

    def __post_init__(self) -> None:
        """Raise CallerError for the number of a flow that there cannot be."""
        whole_number("flow", self.flow, 1)
        if self.far_flow is not None:
            whole_number("far-flow", self.far_flow, 1)
        for name, value in (("--bits", self.bits), ("--numbers", self.numbers)):
            if value is not None and self.sequence_at is None:
                raise CallerError(f"{name}: says what --sequence-at has; give --sequence-at OFFSET:BYTES")


def probe_period_ns(period_s: float) -> int:
    """Return the period of the simulated probe; raise CallerError if it is too short or too long."""
    if not _SHORTEST_PERIOD_S <= real_number("period", period_s) <= _LONGEST_PERIOD_S:
        raise CallerError(
            f"a probe every {period_s:g} s: expected one every {_SHORTEST_PERIOD_S:g} to "
            f"{_LONGEST_PERIOD_S:g} s"
        )
    return round(period_s * NS_PER_S)


FILE_OPTIONS = {
    "clocks_differ": "--clocks",
    "flow": "--flow",
    "far_flow": "--far-flow",
    "sequence_at": "--sequence-at",
    "bits": "--bits",
    "numbers": "--numbers",
    "period_ns": "--rate",
}
"""Options of the command line, by field of :class:`SourceOptions`."""
_CAPTURE_OPTIONS = ("clocks_differ", "flow", "far_flow", "sequence_at", "bits", "numbers")


def refuse_unused(options: "DataclassInstance", names: Mapping[str, str], source: str, *used: str) -> None:
    """Raise CallerError for an option that differs from its default, but has no effect.

    Args:
        options: a dataclass with defaults.
        names: the options of the command line, by field.
        source: the kind of source that the options are given for.
        used: the fields that have an effect there.
    """
    for field in fields(options):
        is_given = getattr(options, field.name) != field.default
        if is_given and field.name in names and field.name not in used:
            raise CallerError(f"{names[field.name]}: has no effect on {source}")


def read_files(
    paths: Sequence[Path], options: SourceOptions | None = None, others: Sequence[str] = ()
) -> PacketTrace:
    """Return the packet trace in a file, or in the captures of the sender's and receiver's ends.

    ``others`` are further kinds of sources that the caller reads, for the message about a wrong file.

    Raises:
        NoackError: one line; it cannot be read, or is not a trace.
    """
    if not paths:
        raise CallerError("no file is given; give a packet trace, or the name of a shipped one")
    options, first_path = options or SourceOptions(), paths[0]
    heads = [_head(path) for path in paths]
    if all(map(is_capture, heads)) and len(paths) < 3:
        refuse_unused(options, FILE_OPTIONS, "captures", *_CAPTURE_OPTIONS)
        return _from_captures(paths, options)
    if len(paths) > 1:
        raise CallerError(
            "expected one file, or two captures (pcap, pcapng): that of the sender's end, then "
            "that of the receiver's"
        )
    if is_iperf3(heads[0]):
        raise CallerError(f"{first_path}: a report of iperf3 has losses per interval, and no packets")
    if is_fping(heads[0]):
        refuse_unused(options, FILE_OPTIONS, "a log of fping", "flow")
        return _of_target(_targets(first_path), options.flow, first_path)
    if is_opportunity_file(heads[0]):
        if is_compressed(first_path):
            raise CallerError(
                f"{first_path}: delivery opportunities are not read compressed; gunzip it first"
            )
        refuse_unused(options, FILE_OPTIONS, "delivery opportunities", "period_ns")
        return read_opportunities(first_path, options.period_ns)
    refuse_unused(options, FILE_OPTIONS, "a packet trace", "clocks_differ")
    return read_trace(first_path, clocks_differ=bool(options.clocks_differ), others=(*others, _OPPORTUNITIES))


class FlowTrace(NamedTuple):
    """One of the flows of a source."""

    number: int
    """For ``--flow``."""
    name: str
    trace: PacketTrace | None
    problem: str
    """Why there is no trace."""


MOST_FLOWS = 50
"""Flows of a capture that are measured at once, the largest ones."""


def read_flows(paths: Sequence[Path], options: SourceOptions | None = None) -> tuple[list[FlowTrace], int]:
    """Return the flows of captures, or the targets of a log of fping, and how many more there are.

    Raises:
        NoackError: one line; it cannot be read, or is of another kind, which has one flow.
    """
    options = options or SourceOptions()
    if not paths:
        raise CallerError("no file is given; give a capture, or a log of fping")
    for name, value in (("--flow", options.flow), ("--far-flow", options.far_flow)):
        if value not in (1, None):
            raise CallerError(f"{name} {value}: has no effect beside --flows, which measures all flows")
    heads = [_head(path) for path in paths]
    if len(paths) == 1 and is_fping(heads[0]):
        refuse_unused(options, FILE_OPTIONS, "a log of fping")
        traces = _targets(paths[0])
        flows = [FlowTrace(number, name, trace, "") for number, (name, trace) in enumerate(traces.items(), 1)]
        return flows[:MOST_FLOWS], max(len(flows) - MOST_FLOWS, 0)
    if not all(map(is_capture, heads)) or len(paths) > 2:
        raise CallerError(
            "--flows: is for captures (pcap, pcapng) and for logs of fping; other sources have one flow"
        )
    refuse_unused(options, FILE_OPTIONS, "captures", *_CAPTURE_OPTIONS)
    names = _flow_names(paths[0])
    flows = []
    for number, name in enumerate(names[:MOST_FLOWS], 1):
        try:
            trace = _from_captures(paths, replace(options, flow=number))
            flows.append(FlowTrace(number, name, trace, ""))
        except CallerError as error:
            flows.append(FlowTrace(number, name, None, _without_path(str(error), paths)))
    return flows, max(len(names) - MOST_FLOWS, 0)


def is_iperf3_file(path: Path) -> bool:
    """Whether a file is a report of iperf3, which :mod:`netem.traces.iperf3_report` reads."""
    return not path.is_dir() and is_iperf3(_head(path))


def _flow_names(path: Path) -> list[str]:
    try:
        with open_regular(path) as file:
            return [str(flow) for flow in Capture(decompressed(file)[1]).flows]
    except FILE_ERRORS as error:
        raise CallerError(f"{path}: {file_problem(error)}") from None


def _without_path(message: str, paths: Sequence[Path]) -> str:
    for path in paths:
        message = message.removeprefix(f"{path}: ")
    return message


def _targets(path: Path) -> Mapping[str, PacketTrace]:
    try:
        with open_regular(path) as file:
            return read_targets(decompressed(file)[1], MAX_PACKETS)
    except FILE_ERRORS as error:
        raise CallerError(f"{path}: {file_problem(error)}") from None


def _of_target(traces: Mapping[str, PacketTrace], number: int, path: Path) -> PacketTrace:
    """Return the trace of a target of fping; 1 is the first."""
    if not 1 <= number <= len(traces):
        raise CallerError(f"{path}: has no flow {number}; its targets are flows 1 to {len(traces)}")
    target, trace = list(traces.items())[number - 1]
    others = (
        f"; --flow chooses another of the {len(traces)} targets, --flows measures all"
        if len(traces) > 1
        else ""
    )
    return trace.noted(f"flow {number}: {target}{others}")


def _head(path: Path) -> bytes:
    """Return how a file begins, decompressed if necessary."""
    try:
        with open_regular(path) as file:
            head = decompressed(file)[0][:_HEAD_BYTES]
    except FILE_ERRORS as error:
        raise CallerError(f"{path}: {file_problem(error)}") from None
    if not head:
        raise CallerError(f"{path}: is empty")
    return head


def _from_captures(paths: Sequence[Path], options: SourceOptions) -> PacketTrace:
    try:
        field = None
        if options.sequence_at is not None:
            field = SequenceField.parse(options.sequence_at, options.bits, options.numbers)
    except ValueError as error:
        raise CallerError(str(error)) from None
    try:
        with ExitStack() as stack:
            files = [decompressed(stack.enter_context(open_regular(path)))[1] for path in paths]
            chosen = CaptureOptions(options.flow, options.far_flow, field, options.clocks_differ)
            return read_captures(files, chosen)
    except CaptureFileError as error:
        raise CallerError(f"{paths[error.place]}: {one_line(error)}") from None
    except FILE_ERRORS as error:
        raise CallerError(f"{', '.join(map(str, paths))}: {file_problem(error)}") from None


_LINES = re.compile(rb"(?:[0-9]{1,15}[ \t]*\r?\n)+[0-9]{0,15}")
_PROBE_BYTES = 100
_MOST_PROBES = _MOST_IN_FLIGHT = 1_000_000


def is_opportunity_file(head: bytes) -> bool:
    """Whether a file begins with lines of one whole number each."""
    return _LINES.fullmatch(head) is not None


def read_opportunities(path: Path, period_ns: int) -> PacketTrace:
    """Return the trace of a probe with this period, for as long as the file.

    Raises:
        CallerError: one line; the file cannot be read, or is wrong.
    """
    opportunities = Opportunities(file=str(path)).read_file(NamedFile(str(path), Path()))
    times_ms = np.array(opportunities.times_ms)
    probes = opportunities.length_ns // period_ns
    if not 1 <= probes <= _MOST_PROBES:
        raise CallerError(
            f"{path}: {opportunities.length_ns / 1e9:g} s are {probes} datagrams of the simulated probe; "
            f"expected 1 to {_MOST_PROBES}; choose another --rate"
        )
    link = LinkState(
        LinkSettings(impairments=(opportunities,), mansd=None, limit=min(max(probes, 1), 1_000_000)),
        0,
        "link",
        "forward",
    )
    link.start_flow(0, 0)
    sent_ns = np.arange(probes) * period_ns
    received_ns = np.full(probes, LOST_NS)
    for k, at_ns in enumerate(sent_ns.tolist()):
        release_ns = link.decide(0, _PROBE_BYTES, at_ns).release_ns
        if release_ns != core.NOACK_NEVER_NS:
            received_ns[k] = release_ns
    rate_bps = len(times_ms) * OPPORTUNITY_BYTES * 8 * NS_PER_S / opportunities.length_ns
    gaps_ms = np.diff(times_ms, prepend=0)
    k = int(gaps_ms.argmax())
    return packet_trace(sent_ns, received_ns, received_ns == LOST_NS).noted(
        f"delivery opportunities of mahimahi: {len(times_ms)} in {opportunities.length_ns / 1e9:g} s, "
        f"{rate_bps / 1e6:.4g} Mbit/s; longest time without one: {gaps_ms[k]} ms, "
        f"before {times_ms[k] / 1e3:g} s",
        f"they say nothing about losses: this is a simulated probe, {_PROBE_BYTES} bytes every "
        f"{period_ns / 1e6:g} ms, through a link with them",
    )
