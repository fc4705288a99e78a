"""The rows of a run of several loops, mixed as its processes send them."""

from collections.abc import Iterator, Mapping

import numpy as np

from cosim.record.run_record import RecordedRun, Rows, RunRecord
from netem.core.packet_rows import NETEM_PACKET
from noack.protocol.record_tables import LOOP, OWNER, network_tables

BATCH_NS = 100_000_000


def mixed_rows(shared: RecordedRun) -> Mapping[str, Rows]:
    """All rows by table, as the processes emit them: with the loop's number, in order of time."""
    mixed = {}
    for table, dtype in shared.resolved.tables.items():
        if table in network_tables():
            mixed[table] = shared.network[table]
            continue
        of_loops = (numbered(loop, number, table, dtype) for number, loop in enumerate(shared.loops))
        rows = np.concatenate([*of_loops])
        mixed[table] = rows[np.argsort(rows["now_ns"], kind="stable")]
    return mixed


def live_rows(run: RecordedRun) -> Iterator[tuple[str, Rows]]:
    """Yield the rows as the processes send them: those of all loops mixed, batch by batch."""
    network = run.network
    every = {NETEM_PACKET: network[NETEM_PACKET]}
    for table, dtype in run.resolved.tables.items():
        if OWNER[table] != "netem":
            of_loops = [numbered(record, i, table, dtype) for i, record in enumerate(run.loops)]
            every[table] = np.concatenate(of_loops)
    for begin_ns in range(0, 2 * network.scenario.timing.horizon_ns, BATCH_NS):
        for table, rows in every.items():
            now_ns = rows["now_ns"]
            chosen = rows[(now_ns >= begin_ns) & (now_ns < begin_ns + BATCH_NS)]
            if len(chosen):
                yield table, chosen


def numbered(record: RunRecord, number: int, table: str, dtype: np.dtype[np.void]) -> Rows:
    """Return the rows of a loop in a table, with the loop's number."""
    rows = np.zeros(record.count(table), dtype)
    rows[LOOP] = number
    for name in record[table].dtype.names or ():
        rows[name] = record[table][name]
    return rows
