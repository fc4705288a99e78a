"""The outcome of each update in the network emulator."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.record.run_record import Rows, RunRecord, updates_in
from noack.protocol.record_tables import (
    ACKNOWLEDGEMENTS,
    NETEM_PACKET,
    NETEM_RELEASE,
    UPDATES,
    effective,
)
from noack.protocol.wire_format import Flow


class PacketOutcome(NamedTuple):
    """The outcomes of k updates."""

    rows: Rows
    """Their rows of ``netem_packet``, (k,)."""
    sequence: NDArray[np.int64]
    event_ns: NDArray[np.int64]
    lost: NDArray[np.bool_]
    """Dropped, corrupted, or delivered out of order (stale)."""
    in_flight: NDArray[np.bool_]
    """Not yet forwarded when the run ended."""

    @property
    def forwarded(self) -> NDArray[np.bool_]:
        """Forwarded intact, and before every newer update."""
        return ~self.lost & ~self.in_flight

    def longest_loss_burst(self) -> int:
        """Largest number of consecutive losses."""
        longest = count = 0
        for lost in self.lost.tolist():
            count = count + 1 if lost else 0
            longest = max(longest, count)
        return longest


def packet_outcomes(record: RunRecord, flow: Flow = Flow.UPDATE) -> PacketOutcome:
    """Return the outcomes of the updates or acknowledgements that reached the network emulator."""
    rows, sequence, event_ns = updates_in(record[NETEM_PACKET], flow)
    releases = record[NETEM_RELEASE]
    if record.scenario.protocol.acknowledges:
        direction = ACKNOWLEDGEMENTS if flow is Flow.ACKNOWLEDGEMENT else UPDATES
        releases = releases[releases["flow"] == direction]
    # Of a datagram and its copy, the first intact one counts; it may be the copy.
    which = (rows["bit"] >= 0).astype(np.int64)
    numbers = 2 * rows["sequence"] + which
    forwarded = 2 * releases["sequence"] + releases["copy"]
    effectively = effective(rows["fate"])
    stale = np.isin(numbers, forwarded[releases["stale"] != 0])
    delayed = np.where(which == 1, rows["copy_ns"], rows["release_ns"]) > rows["now_ns"]
    in_flight = effectively & delayed & ~np.isin(numbers, forwarded)
    return PacketOutcome(rows, sequence, event_ns, ~effectively | stale, in_flight)
