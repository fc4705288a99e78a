"""Copies of a record that differ in some places, and what its parts say together."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from cosim.record.align import Reals, bounded_parts
from cosim.record.run_record import Rows, RunRecord

NO_CHANGE: Mapping[str, Rows] = {}
CONTENT: dict[str, Any] = {
    "name": "changing",
    "horizon_s": 3.0,
    "model": {"name": "double_integrator"},
    "plant": {
        "initial_state": [1.0, 0.0],
        "rate_hz": 100.0,
        "draw": "uniform",
        "uncertainty_A": [[0.0, 0.0], [0.0, 0.5]],
    },
    "controller": {"rate_hz": 100.0},
    "trigger": {"beta": 0.02, "alpha_per_s": 0.25},
    "network": {"mansd": 3, "loss": {"model": "bernoulli", "probability": 0.8}},
}
"""Of a run whose runtime parameters change."""


def copied(record: RunRecord) -> dict[str, Rows]:
    """The rows of all tables, to be changed in place."""
    return {table: record[table].copy() for table in record.tables}


def changed(record: RunRecord, rows: Mapping[str, Rows] = NO_CHANGE, **others: Any) -> RunRecord:
    """The record with other rows of some tables, or another scenario, notices, reports or kind."""
    all_rows = {table: rows.get(table, record[table]) for table in record.tables}
    names = ("scenario", "notices", "reports", "kind", "number", "roles")
    attributes = {name: getattr(record, name) for name in names}
    return RunRecord(rows=all_rows, **(attributes | others))


def flipped(record: RunRecord, table: str, row: int, column: str, bit: int) -> RunRecord:
    """The record with a flipped bit of one value."""
    rows = record[table].copy()
    raw = bytearray(rows[column][row].tobytes())
    raw[bit // 8] ^= 1 << bit % 8
    kind = rows.dtype[column]
    rows[column][row] = np.frombuffer(raw, kind.base).reshape(kind.shape)
    return changed(record, {table: rows})


def identity_residual(record: RunRecord) -> Reals:
    """The residual of (I1) at each measurement of a run, (k,)."""
    return np.concatenate([part.residual for part in bounded_parts(record)])
