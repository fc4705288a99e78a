"""A stopped run up to the last time that all of its processes reached.

They end some milliseconds apart, and the loop is incomplete after the first of them.
"""

import numpy as np

from cosim.record.run_record import Rows, RunRecord
from noack.protocol.record_tables import OWNER, SENSOR_MEASUREMENT, STEP_TABLES
from noack.protocol.roles import LOOP_ROLES
from noack.runtime.end_reasons import HORIZON


def common_end_ns(record: RunRecord) -> int | None:
    """Return the latest time that every process of a stopped run reached.

    None if the run was not stopped, or if a process did not report its time.
    """
    reports = [record.reports.get(role, {}) for role in LOOP_ROLES]
    if all(report.get("ended") == HORIZON for report in reports):
        return None
    reached_ns = [report.get("reached_ns") for report in reports]
    known_ns = [int(t_ns) for t_ns in reached_ns if t_ns is not None]
    measured_ns = record.last_ns(SENSOR_MEASUREMENT)
    if len(known_ns) < len(reports) or measured_ns is None:
        return None
    # A sensor has no deadlines, so its time is that of its last measurement.
    return int(min(*known_ns, measured_ns))


def up_to_common_end(record: RunRecord) -> RunRecord:
    """Return the record of a run up to its common end; the record itself if it has none.

    The rows of each process are cut at its first row beyond that time, in all tables.
    """
    end_ns = common_end_ns(record)
    if end_ns is None:
        return record
    before: dict[str, int] = {}
    for role, table in STEP_TABLES.items():
        column = "now_ns" if role == "netem" else "t_ns"
        later = (rows["input"][rows[column] > end_ns] for rows in record.batches(table))
        first = next(filter(len, later), None)
        before[role] = int(np.iinfo(np.int64).max if first is None else first[0])

    def derive(table: str, rows: Rows) -> Rows:
        return rows.compress(rows["input"] < before[OWNER[table]])

    return record.derived(record.scenario, derive)
