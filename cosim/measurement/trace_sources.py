"""Packet traces from all that can be measured: files of known formats, run directories."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from cosim.measurement.fate_source import is_fate_file, read_fate_file
from cosim.measurement.opportunity_source import is_opportunity_file, read_opportunities
from cosim.measurement.run_source import read_run
from noack.core.errors import CallerError, one_line, why
from noack.core.file_access import open_regular
from noack.traces.capture_packets import is_capture
from noack.traces.capture_trace import CaptureOptions, SequenceField, read_captures
from noack.traces.packet_trace import PacketTrace
from noack.traces.trace_formats import read_trace

_HEAD_BYTES = 64
_OTHERS = ("fate files", "run directories", "delivery opportunities")


@dataclass(frozen=True)
class SourceOptions:
    """How to read a source."""

    clocks_differ: bool | None = None
    """Whether sending and receiving times were read on different clocks; None: what is usual for
    the source: only in captures of both ends they were."""
    flow: int = 1
    """Which flow of a capture or a fate file, by its number of packets; 1 is the largest."""
    sequence_at: str | None = None
    """Where the payloads of a capture have sequence numbers: ``OFFSET:BYTES[:little]``."""
    period_ns: int = 20_000_000
    """Period of the simulated probe through delivery opportunities."""


FILE_OPTIONS = {
    "clocks_differ": "--clocks", "flow": "--flow", "sequence_at": "--sequence-at",
    "period_ns": "--rate",
}  # fmt: skip
"""Options of the command line, by field of :class:`SourceOptions`."""


def refuse_unused(options: Any, names: Mapping[str, str], what: str, *used: str) -> None:
    """Raise CallerError for an option that differs from its default, but has no effect.

    Args:
        options: a dataclass with defaults.
        names: the options of the command line, by field.
        what: what the options are given for.
        used: the fields that have an effect there.
    """
    for field in fields(options):
        is_given = getattr(options, field.name) != field.default
        if is_given and field.name in names and field.name not in used:
            raise CallerError(f"{names[field.name]}: has no effect on {what}")


def read_source(paths: Sequence[Path], options: SourceOptions | None = None) -> PacketTrace:
    """Return the packet trace in a file, or in the captures of the sender's and receiver's ends.

    Raises:
        NoackError: one line; it cannot be read, or is not a trace.
    """
    options, first = options or SourceOptions(), paths[0]
    if len(paths) == 1 and first.is_dir():
        refuse_unused(options, FILE_OPTIONS, "a run directory")
        return read_run(first)
    heads = [_head(path) for path in paths]
    if all(map(is_capture, heads)) and len(paths) < 3:
        refuse_unused(options, FILE_OPTIONS, "captures", "clocks_differ", "flow", "sequence_at")
        return _from_captures(paths, options)
    if len(paths) > 1:
        raise CallerError(
            "expected one file, or two captures (pcap, pcapng): that of the sender's end, then "
            "that of the receiver's"
        )
    if is_fate_file(heads[0]):
        refuse_unused(options, FILE_OPTIONS, "a fate file", "flow")
        return read_fate_file(first, options.flow)
    if is_opportunity_file(heads[0]):
        refuse_unused(options, FILE_OPTIONS, "delivery opportunities", "period_ns")
        return read_opportunities(first, options.period_ns)
    refuse_unused(options, FILE_OPTIONS, "a packet trace", "clocks_differ")
    return read_trace(first, clocks_differ=bool(options.clocks_differ), others=_OTHERS)


def _head(path: Path) -> bytes:
    try:
        with open_regular(path) as file:
            return file.read(_HEAD_BYTES)
    except (OSError, ValueError) as error:
        reason = f"cannot be read: {why(error)}" if isinstance(error, OSError) else str(error)
        raise CallerError(f"{path}: {reason}") from None


def _from_captures(paths: Sequence[Path], options: SourceOptions) -> PacketTrace:
    try:
        field = None if options.sequence_at is None else SequenceField.parse(options.sequence_at)
    except ValueError as error:
        raise CallerError(f"--sequence-at: {error}") from None
    try:
        with ExitStack() as stack:
            files = [stack.enter_context(open_regular(path)) for path in paths]
            return read_captures(files, CaptureOptions(options.flow, field, options.clocks_differ))
    except (OSError, ValueError) as error:
        names = ", ".join(map(str, paths))
        raise CallerError(f"{names}: {one_line(error)}") from None
