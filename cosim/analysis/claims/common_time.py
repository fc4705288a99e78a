"""The common end of a stopped run: the time up to which all its processes took part.

The processes of a stopped run end some milliseconds apart. Claims and conditions are checked up to
the common end only, because the loop is incomplete after it.
"""

import numpy as np

from cosim.record.run_record import Rows, RunRecord
from noack.protocol.record_tables import (
    CONTROLLER_STEP,
    NETEM_PACKET,
    OWNER,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
)
from noack.protocol.topology import LOOP_ROLES
from noack.runtime.life_cycle import HORIZON

_PACES = {
    "plant": (PLANT_STEP, "t_ns"),
    "sensor": (SENSOR_MEASUREMENT, "t_ns"),
    "netem": (NETEM_PACKET, "now_ns"),
    "controller": (CONTROLLER_STEP, "t_ns"),
}
"""By process: the table and column with the times of its steps."""


def common_end_ns(record: RunRecord) -> int | None:
    """Return the latest time that every process of a stopped run reached.

    None if the run was not stopped, or if a process did not report its time.
    """
    reports = [record.reports.get(role, {}) for role in LOOP_ROLES]
    if all(report.get("ended") == HORIZON for report in reports):
        return None
    reached_ns = [report.get("reached_ns") for report in reports]
    known_ns = [int(one) for one in reached_ns if one is not None]
    measured_ns = record[SENSOR_MEASUREMENT]["t_ns"]
    if len(known_ns) < len(reports) or not len(measured_ns):
        return None
    # A sensor has no deadlines, so its time is that of its last measurement.
    return int(min(*known_ns, measured_ns[-1]))


def up_to_common_end(record: RunRecord) -> RunRecord:
    """Return the record of a run up to its common end; the record itself if it has none.

    The rows of each process are cut at its first row beyond that time, in all tables.
    """
    end_ns = common_end_ns(record)
    if end_ns is None:
        return record
    rows: dict[str, Rows] = {}
    for role, (pace, column) in _PACES.items():
        beyond = record[pace]["input"][record[pace][column] > end_ns]
        first = int(beyond[0]) if len(beyond) else np.iinfo(np.int64).max
        for table in record.tables:
            if OWNER[table] == role:
                rows[table] = record[table][record[table]["input"] < first]
    return RunRecord(
        record.scenario, rows, record.notices, record.reports, record.kind, record.earlier
    )
