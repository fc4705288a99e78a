"""Packet traces from the fate files of the emulator (`noack netem --record-fates`)."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from netem.fates import opened_fates
from noack.core.errors import CallerError
from noack.protocol.record_tables import Fate
from noack.traces.packet_trace import (
    LOST_NS,
    MAX_PACKETS,
    PacketTrace,
    TraceRecordError,
    packet_trace,
)

_FLOW = ("link", "direction", "flow")
_COLUMNS = (
    *_FLOW, "packet", "arrival_ns", "fate", "delay_ns", "copy_delay_ns", "bit", "copy_bit",
)  # fmt: skip
_LATEST_NS = 2**61


def is_fate_file(head: bytes) -> bool:
    """Whether a file that begins with these bytes may be a fate file: it is Parquet."""
    return head[:4] == b"PAR1"


def read_fate_file(path: Path, number: int) -> PacketTrace:
    """Return the trace of a flow, chosen by its number of packets; 1 is the largest.

    A corrupted datagram is a lost one; of a datagram and its copy, the first intact one counts.

    Raises:
        CallerError: one line; it is not a complete fate file, or has no such flow.
    """
    with opened_fates(path) as (file, _):
        counts: Counter[tuple[Any, ...]] = Counter()
        for batch in file.iter_batches(columns=list(_FLOW)):
            table = pa.Table.from_batches([batch]).group_by([*_FLOW]).aggregate([([], "count_all")])
            for row in table.to_pylist():
                counts[tuple(row[name] for name in _FLOW)] += row["count_all"]
        if not 1 <= number <= len(counts):
            raise CallerError(f"{path}: has no flow {number}; its flows are 1 to {len(counts)}")
        chosen, packets = counts.most_common(number)[-1]
        if packets > MAX_PACKETS:
            raise CallerError(f"{path}: the flow has more than {MAX_PACKETS} packets")
        parts = []
        for batch in file.iter_batches(columns=list(_COLUMNS)):
            columns = {
                name: np.asarray(batch[name].to_numpy(zero_copy_only=False)) for name in _COLUMNS
            }
            here = np.logical_and.reduce(
                [columns[name] == value for name, value in zip(_FLOW, chosen, strict=True)]
            )
            parts.append([columns[name][here] for name in _COLUMNS[3:]])
    rows = dict(zip(_COLUMNS[3:], map(np.concatenate, zip(*parts, strict=True)), strict=True))
    received_ns, lost = _received(path, rows)
    try:
        trace = packet_trace(rows["arrival_ns"], received_ns, lost, rows["packet"])
    except TraceRecordError as error:
        raise CallerError(f"{path}: packet {rows['packet'][error.row]} {error}") from None
    link, direction, flow = chosen
    others = f"; --flow chooses another of the {len(counts)} flows" if len(counts) > 1 else ""
    return trace.noted(f"flow {number}: {link} {direction}, flow {flow}, {packets} packets{others}")


def _received(
    path: Path, rows: dict[str, NDArray[Any]]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the times of the first intact delivery, and which packets have none."""
    delays = rows["delay_ns"], rows["copy_delay_ns"]
    if max(int(np.abs(one).max(initial=0)) for one in (*delays, rows["arrival_ns"])) > _LATEST_NS:
        raise CallerError(f"{path}: has a time that is too large")
    never = np.iinfo(np.int64).max
    dropped = np.isin(rows["fate"], [Fate.DROPPED, Fate.OVERFLOWED, Fate.BLACKED_OUT])
    intact = [
        np.where((delay >= 0) & (rows[bit] < 0) & ~dropped, delay, never)
        for delay, bit in zip(delays, ("bit", "copy_bit"), strict=True)
    ]
    delay_ns = np.minimum(*intact)
    lost = delay_ns == never
    return np.where(lost, LOST_NS, rows["arrival_ns"] + np.where(lost, 0, delay_ns)), lost
