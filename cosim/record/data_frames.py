"""Tables of a run for data frames: Arrow tables, which pandas and polars accept directly."""

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from cosim.record.align import align_tables
from cosim.record.run_events import packet_outcomes
from cosim.record.run_record import RunRecord
from netem.core.clock import NS_PER_S
from netem.core.packet_rows import Fate, effective
from noack.protocol.record_tables import CONTROLLER_DELIVERY, NO_SEQUENCE, SENSOR_MEASUREMENT, entry_names
from noack.scenario.scenario import Scenario

_NOT_RECEIVED = "none"
_OUT_OF_ORDER = "delivered_out_of_order"
_IN_FLIGHT = "in_flight"


def with_seconds(table: pa.Table) -> pa.Table:
    """Insert ``t_s``, the time ``t_ns`` in seconds, before the columns of a table."""
    return table.add_column(0, "t_s", pa.array(_seconds(table["t_ns"].to_numpy())))


@np.errstate(all="ignore")  # a run may diverge
def with_outputs(table: pa.Table, scenario: Scenario) -> pa.Table:
    """Add the states and the scenario's outputs to a table with x, by their names."""
    names = entry_names("x", scenario.model.dimensions[0])
    if set(names) <= set(table.column_names):
        x = np.column_stack([table[name].to_numpy() for name in names])
        for name, values in _by_name(x, scenario).items():
            if name not in table.column_names:
                table = table.append_column(name, pa.array(values))
    return table


def _by_name(x: NDArray[np.float64], scenario: Scenario) -> dict[str, NDArray[np.float64]]:
    """Return the states and the stated outputs, (k,) each, by their names."""
    states, _ = scenario.entry_names
    stated = scenario.loop_outputs() if scenario.outputs else ()
    by_name = dict(zip(states, x.T, strict=True))
    return by_name | {output.name: x @ np.array(output.row) for output in stated}


@np.errstate(all="ignore")  # a run may diverge
def samples(record: RunRecord) -> pa.Table:
    """Return plant, sensor and controller on the measurements' grid; :meth:`noack.Run.samples`."""
    aligned = align_tables(record)
    columns: dict[str, NDArray[np.generic]] = {"t_s": _seconds(aligned.t_ns), "t_ns": aligned.t_ns}
    for name, states in (("x", aligned.x), ("x_s", aligned.x_s), ("x_c", aligned.x_c)):
        columns |= dict(zip(entry_names(name, states.shape[1]), states.T, strict=True))
    columns |= {n: v for n, v in _by_name(aligned.x, record.scenario).items() if n not in columns}
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
