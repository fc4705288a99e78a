"""Packet traces of runs: the updates, from the emulator to the controller; and of all other sources."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cosim.record.run_events import packet_outcomes
from cosim.record.run_record import RunRecord, load_record
from netem.core.errors import CallerError
from netem.measurement.trace_sources import FILE_OPTIONS, SourceOptions, read_files, refuse_unused
from netem.traces.packet_trace import LOST_NS, PacketTrace, packet_trace
from noack.protocol.record_tables import CONTROLLER_DELIVERY


def read_source(paths: Sequence[Path], options: SourceOptions | None = None) -> PacketTrace:
    """Return the packet trace of a run directory, or of files (:func:`read_files`).

    Raises:
        NoackError: one line; it cannot be read, or is not a trace.
    """
    if len(paths) == 1 and paths[0].is_dir():
        refuse_unused(options or SourceOptions(), FILE_OPTIONS, "a run directory")
        return read_run(paths[0])
    return read_files(paths, options, ("run directories",))


def read_run(run_dir: Path) -> PacketTrace:
    """Return the trace of a run's updates.

    Raises:
        NoackError: it is not a run, or has no updates.
    """
    try:
        return updates_trace(load_record(run_dir))
    except ValueError as error:
        raise CallerError(f"{run_dir}: {error}") from None


def updates_trace(record: RunRecord) -> PacketTrace:
    """Return the trace of the updates: sent when they reached the emulator.

    Updates that were in flight at the end are left out. Raise ValueError if there are none.
    """
    outcomes = packet_outcomes(record)
    arrived = record.columns(CONTROLLER_DELIVERY, "sequence", "now_ns")
    numbers, first_row = np.unique(arrived["sequence"], return_index=True)
    received_ns = np.full(len(outcomes.sequence), LOST_NS)
    if len(numbers):
        row = np.minimum(np.searchsorted(numbers, outcomes.sequence), len(numbers) - 1)
        has_arrived = numbers[row] == outcomes.sequence
        received_ns[has_arrived] = arrived["now_ns"][first_row[row[has_arrived]]]
    sent_ns, lost = outcomes.now_ns, received_ns == LOST_NS
    ended = ~(outcomes.in_flight & lost)
    if not ended.any():
        raise ValueError("no updates reached the network emulator")
    trace = packet_trace(sent_ns[ended], np.maximum(received_ns, sent_ns)[ended], lost[ended])
    in_flight = int((~ended).sum())
    notes = [f"left out: {in_flight} updates in flight at the end"] if in_flight else []
    return trace.noted("the updates of the run, from emulator to controller", *notes)
