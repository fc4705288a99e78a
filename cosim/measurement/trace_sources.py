"""Packet traces from all that can be measured: files of known formats, run directories."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from cosim.measurement.relative_delay import relative_delays
from noack.core.errors import CallerError
from noack.traces.packet_trace import PacketTrace
from noack.traces.trace_formats import read_trace


@dataclass(frozen=True)
class SourceOptions:
    """How to read a source."""

    clocks_differ: bool | None = None
    """Whether sending and receiving times were read on different clocks; None: the usual for the
    source, which is only for captures of both ends that they do."""


class SourcedTrace(NamedTuple):
    """A packet trace, and lines about how it was obtained."""

    trace: PacketTrace
    notes: Sequence[str] = ()


def read_source(paths: Sequence[Path], options: SourceOptions | None = None) -> SourcedTrace:
    """Return the packet trace in a file or in files that belong together.

    Raises:
        CallerError: one line; it cannot be read, or is not a trace.
    """
    options = options or SourceOptions()
    if len(paths) != 1:
        raise CallerError(f"expected one file, found {len(paths)}")
    differ = bool(options.clocks_differ)
    trace = read_trace(paths[0], clocks_differ=differ)
    if not differ:
        return SourcedTrace(trace)
    trace, comparison = relative_delays(trace)
    return SourcedTrace(trace, comparison.lines())
