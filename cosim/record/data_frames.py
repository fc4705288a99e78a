"""Tables of a run for data frames: Arrow tables, which pandas and polars accept directly."""

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from cosim.record.align import align_tables
from cosim.record.run_events import packet_outcomes
from cosim.record.run_record import RunRecord
from noack.core.clock import NS_PER_S
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    NO_SEQUENCE,
    SENSOR_MEASUREMENT,
    Fate,
    effective,
    entry_names,
)
from noack.scenario.scenario import Scenario

_NOT_RECEIVED = "none"
_OUT_OF_ORDER = "delivered_out_of_order"
_IN_FLIGHT = "in_flight"


def with_seconds(table: pa.Table) -> pa.Table:
    """Insert ``t_s``, the time ``t_ns`` in seconds, before the columns of a table."""
    return table.add_column(0, "t_s", pa.array(_seconds(table["t_ns"].to_numpy())))


@np.errstate(all="ignore")  # a run may diverge
def with_outputs(table: pa.Table, scenario: Scenario) -> pa.Table:
    """Add each output that a scenario states to a table with the plant's x, by the output's name."""
    outputs = scenario.loop_outputs() if scenario.outputs else ()
    names = entry_names("x", len(outputs[0].row)) if outputs else ()
    if names and set(names) <= set(table.column_names):
        columns = [table[name].to_numpy() for name in names]
        for output in outputs:
            if output.name not in table.column_names:
                values = np.column_stack(columns) @ np.array(output.row)
                table = table.append_column(output.name, pa.array(values))
    return table


@np.errstate(all="ignore")  # a run may diverge
def samples(record: RunRecord) -> pa.Table:
    """Return plant, sensor and controller on the measurements' grid; :meth:`noack.Run.samples`."""
    aligned = align_tables(record)
    columns: dict[str, NDArray[np.generic]] = {"t_s": _seconds(aligned.t_ns), "t_ns": aligned.t_ns}
    for name, states in (("x", aligned.x), ("x_s", aligned.x_s), ("x_c", aligned.x_c)):
        columns |= dict(zip(entry_names(name, states.shape[1]), states.T, strict=True))
    for output in record.scenario.loop_outputs() if record.scenario.outputs else ():
        columns.setdefault(output.name, aligned.x @ np.array(output.row))
    columns |= {
        "e_s_norm": aligned.e_s_norm,
        "threshold": aligned.threshold,
        "e_c_norm": aligned.e_c_norm,
        "event": record[SENSOR_MEASUREMENT]["event"],
    }
    return _table(columns)


def events(record: RunRecord) -> pa.Table:
    """Return the sensor's transmissions and their fates; :meth:`noack.Run.events`."""
    measurements = record[SENSOR_MEASUREMENT]
    sent = measurements[measurements["event"] != NO_SEQUENCE]
    t_s = _seconds(sent["t_ns"])
    outcomes = packet_outcomes(record)
    fates = np.array([fate.name.lower() for fate in Fate], dtype=object)[outcomes.fate]
    # The emulator forwarded them, but they were not delivered.
    fates[effective(outcomes.fate) & outcomes.lost] = _OUT_OF_ORDER
    fates[outcomes.in_flight] = _IN_FLIGHT
    fate_by_event = dict(zip(outcomes.sequence.tolist(), fates.tolist(), strict=True))
    columns = {
        "event": sent["event"],
        "t_s": t_s,
        "t_ns": sent["t_ns"],
        "interval_s": np.diff(t_s, prepend=np.nan),
        "fate": np.array([fate_by_event.get(int(n), _NOT_RECEIVED) for n in sent["event"]], dtype=np.str_),
        "received": np.isin(sent["event"], record[CONTROLLER_DELIVERY]["sequence"]),
    }
    return _table(columns)


def _table(columns: dict[str, NDArray[np.generic]]) -> pa.Table:
    return pa.table({name: pa.array(np.ascontiguousarray(v)) for name, v in columns.items()})


def _seconds(t_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    return np.asarray(t_ns / NS_PER_S, dtype=np.float64)
