"""The outcome of each update in the network emulator."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.record.run_record import Rows, RunRecord
from noack.protocol.record_tables import (
    NETEM_PACKET,
    NETEM_RELEASE,
    direction_of,
    effective,
)
from noack.protocol.wire_format import HEADER_ROW, MAGIC, VERSIONS, Flow


class PacketOutcome(NamedTuple):
    """The outcomes of k updates."""

    sequence: NDArray[np.int64]
    event_ns: NDArray[np.int64]
    now_ns: NDArray[np.int64]
    """Time of arrival at the network emulator."""
    fate: NDArray[np.int8]
    lost: NDArray[np.bool_]
    """Dropped, corrupted, or delivered out of order (stale)."""
    in_flight: NDArray[np.bool_]
    """Not yet forwarded when the run ended."""
    due_ns: NDArray[np.int64]
    """When it was to leave the network emulator; the time of arrival if it was not delayed."""

    @property
    def forwarded(self) -> NDArray[np.bool_]:
        """Forwarded intact, and before every newer update."""
        return ~self.lost & ~self.in_flight

    def loss_bursts(self) -> NDArray[np.int64]:
        """The lengths of all bursts of consecutive losses, in order."""
        steps = np.diff(self.lost.astype(np.int8), prepend=0, append=0)
        return np.flatnonzero(steps < 0) - np.flatnonzero(steps > 0)

    def longest_loss_burst(self) -> int:
        """Largest number of consecutive losses."""
        return int(self.loss_bursts().max(initial=0))

    def losses_in(self, packets: int) -> NDArray[np.int64]:
        """The number of losses in each ``packets`` consecutive updates; or in all, if fewer."""
        lost = np.append(0, np.cumsum(self.lost))
        width = min(packets, len(self.lost))
        return np.asarray(lost[width:] - lost[: len(lost) - width])


def packet_outcomes(record: RunRecord, flow: Flow = Flow.UPDATE) -> PacketOutcome:
    """Return the outcomes of a flow's datagrams that reached the network emulator."""
    released = _released(record, flow)
    parts = [_outcomes(rows, flow, *released) for rows in record.source.batches(NETEM_PACKET)]
    parts.append(_outcomes(np.zeros(0, record.tables[NETEM_PACKET]), flow, *released))
    return PacketOutcome(*map(np.concatenate, zip(*parts, strict=True)))


def _released(record: RunRecord, flow: Flow) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the numbers of the delayed datagrams that left, with whether each was stale."""
    direction = direction_of(flow)
    every = len(record.scenario.network.flows) == 1
    releases = record.columns(
        NETEM_RELEASE, "sequence", "flow", "copy", "stale",
        where=lambda rows: np.full(len(rows), every) | (rows["flow"] == direction),
    )  # fmt: skip
    return 2 * releases["sequence"] + releases["copy"], releases["stale"] != 0


def _outcomes(
    packets: Rows, flow: Flow, forwarded: NDArray[np.int64], was_stale: NDArray[np.bool_]
) -> PacketOutcome:
    rows, sequence, event_ns = updates_in(packets, flow)
    # Of a datagram and its copy, the first intact one counts; it may be the copy.
    which = (rows["bit"] >= 0).astype(np.int64)
    numbers = 2 * rows["sequence"] + which
    effectively = effective(rows["fate"])
    stale = np.isin(numbers, forwarded[was_stale])
    due_ns = np.maximum(np.where(which == 1, rows["copy_ns"], rows["release_ns"]), rows["now_ns"])
    in_flight = effectively & (due_ns > rows["now_ns"]) & ~np.isin(numbers, forwarded)
    fate, lost = rows["fate"].astype(np.int8), ~effectively | stale
    return PacketOutcome(sequence, event_ns, rows["now_ns"].copy(), fate, lost, in_flight, due_ns)


def updates_in(
    packets: Rows, flow: Flow = Flow.UPDATE
) -> tuple[Rows, NDArray[np.int64], NDArray[np.int64]]:
    """Select the loop's messages of a flow from the packets that reached the network emulator.

    The emulator reads no payload, so the packets' headers are read here.

    Returns:
        Their rows of ``netem_packet``, sequence numbers and event times.
    """
    headers = np.ascontiguousarray(packets["head"]).view(HEADER_ROW)
    mine = (headers["magic"] == MAGIC) & np.isin(headers["version"], VERSIONS)
    mine &= (headers["flow"] == flow) & (headers["t_ns"] >= 0)
    mine &= headers["sequence"] < 2**63  # others do not fit the record's columns
    return (
        packets.compress(mine),
        headers["sequence"].compress(mine).astype(np.int64),
        headers["t_ns"].compress(mine),
    )
