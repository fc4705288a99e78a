"""Packet traces from run directories: the updates, from the emulator to the controller."""

from pathlib import Path

import numpy as np

from cosim.record.run_events import packet_outcomes
from cosim.record.run_record import RunRecord, load_record
from noack.core.errors import CallerError
from noack.protocol.record_tables import CONTROLLER_DELIVERY
from noack.traces.packet_trace import LOST_NS, PacketTrace, packet_trace


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
    numbers, first = np.unique(arrived["sequence"], return_index=True)
    received_ns = np.full(len(outcomes.sequence), LOST_NS)
    if len(numbers):
        at = np.minimum(np.searchsorted(numbers, outcomes.sequence), len(numbers) - 1)
        here = numbers[at] == outcomes.sequence
        received_ns[here] = arrived["now_ns"][first[at[here]]]
    sent_ns, lost = outcomes.now_ns, received_ns == LOST_NS
    ended = ~(outcomes.in_flight & lost)
    if not ended.any():
        raise ValueError("no updates reached the network emulator")
    # Numbers of restarted sensors begin anew far above; the order at the emulator has no gaps.
    trace = packet_trace(sent_ns[ended], np.maximum(received_ns, sent_ns)[ended], lost[ended])
    flying = int((~ended).sum())
    notes = [f"left out: {flying} updates in flight at the end"] if flying else []
    return trace.noted("the updates of the run, from emulator to controller", *notes)
