"""The arguments that every command ``measure`` has, and what they measure, by the kind of the source."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from netem.measurement.flow_table import flows_document
from netem.measurement.iperf3_table import iperf3_document
from netem.measurement.loss_bursts import WINDOWS
from netem.measurement.measure_options import period_ns, refuse, share, time_s
from netem.measurement.network_measurement import QUANTILES, MeasurementOptions, NetworkMeasurement
from netem.measurement.trace_sources import (
    FILE_OPTIONS,
    SourceOptions,
    is_iperf3_file,
    read_files,
    refuse_unused,
)
from netem.output.document import Document
from netem.traces.packet_trace import PacketTrace, find_trace


@dataclass(frozen=True, kw_only=True)
class MeasureArguments:
    """What is read and measured, in the words of a command line; None: the option is not given."""

    sources: Sequence[str]
    flow: int
    flows: bool
    far_flow: int | None
    sequence_at: str | None
    bits: int | None
    numbers: str | None
    clocks: str | None
    """``same`` or ``different``."""
    rate: str
    deadline: str | None
    share: Sequence[str] | None
    window: Sequence[int] | None
    outage: str | None
    within: str
    interval: str | None
    survival: str | None

    @cached_property
    def reading(self) -> SourceOptions:
        """How the sources are read; raise CallerError for a wrong option."""
        differ = None if self.clocks is None else self.clocks == "different"
        return SourceOptions(
            differ, self.flow, self.far_flow, self.sequence_at, self.bits, self.numbers, period_ns(self.rate)
        )

    @cached_property
    def options(self) -> MeasurementOptions:
        """What is measured; raise CallerError for a wrong option."""
        return MeasurementOptions(
            time_s("--deadline", self.deadline),
            tuple(map(share, self.share or ())) or QUANTILES,
            self.window or WINDOWS,
            time_s("--outage", self.outage),
            time_s("--interval", self.interval),
            time_s("--survival", self.survival),
            self.within,
        )


def measure_sources(
    arguments: MeasureArguments,
    of_one_flow: Mapping[str, object],
    read: Callable[[Sequence[Path], SourceOptions], PacketTrace] = read_files,
) -> Document | NetworkMeasurement:
    """Measure the sources: a document of a report of iperf3 or of several flows; else a measurement.

    Args:
        arguments: the sources and options.
        of_one_flow: the further options of the command, by name, which need the packets of one flow.
        read: reads the packets of the sources.

    Raises:
        NoackError: one line; a source cannot be read, or an option is wrong.
    """
    reading, options = arguments.reading, arguments.options
    paths = [*map(find_trace, arguments.sources)]
    if len(paths) == 1 and is_iperf3_file(paths[0]):
        names = ("deadline", "outage", "survival", "share", "window")
        needs_packets = {f"--{name}": getattr(arguments, name) for name in names}
        refuse({**of_one_flow, **needs_packets}, "needs packets; iperf3 counts per interval")
        refuse_unused(reading, FILE_OPTIONS, "a report of iperf3")
        return iperf3_document(paths[0])
    if arguments.flows:
        refuse(of_one_flow, "is of one flow; give --flow N in place of --flows")
        return flows_document(paths, reading, options)
    trace = read(paths, reading)
    return NetworkMeasurement(trace, options, " ".join(arguments.sources), trace.notes)
