"""The inputs of a machine, from its recorded rows."""

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np

from cosim.record.run_record import Rows
from netem.link_machine import Datagram
from noack.config.parameter_changes import ParameterChange, settings_of
from noack.core.linear_systems import Matrix
from noack.protocol.record_tables import (
    CONTROLLER_STEP,
    NETEM_PACKET,
    NETEM_RELEASE,
    OWNER,
    PLANT_STEP,
    SENSOR_ACKNOWLEDGEMENT,
    SETTINGS,
    entry_names,
)
from noack.protocol.topology import RECEIVES
from noack.protocol.wire_format import Flow, Message

_TIMERS = (PLANT_STEP, CONTROLLER_STEP, NETEM_RELEASE)
_MOST_BYTES = 65_535
"""Largest size of a datagram; a damaged record may contain larger numbers."""


def inputs_of(table: str, rows: Rows) -> Iterator[Message | Datagram | ParameterChange | None]:
    """Yield the machine's input of each row; None for its timer."""
    if table in _TIMERS:
        yield from itertools.repeat(None, len(rows))
    elif table in SETTINGS:
        for number, t_ns, data in zip(
            rows["sequence"].tolist(), rows["t_ns"].tolist(), rows["change"].tolist(), strict=True
        ):
            yield ParameterChange(number, t_ns, _settings(data))
    elif table == NETEM_PACKET:
        for flow, size, head, t_ns in zip(
            *(rows[name].tolist() for name in ("flow", "size_bytes", "head", "t_ns")), strict=True
        ):
            size_bytes = min(max(size, 0), _MOST_BYTES)
            yield Datagram(flow, head.ljust(size_bytes, b"\0")[:size_bytes], t_ns)
    else:
        acknowledges = table == SENSOR_ACKNOWLEDGEMENT
        flow = Flow.ACKNOWLEDGEMENT if acknowledges else RECEIVES[OWNER[table]]
        vectors, _ = received_vectors(table, rows)
        # The copy has the memory layout of the decoder's vector: rounding may depend on it.
        copies = (vector.copy() for vector in vectors)
        fields = rows["sequence"].tolist(), rows["t_ns"].tolist(), copies
        yield from map(Message, itertools.repeat(flow), *fields)


def received_vectors(table: str, rows: Rows) -> tuple[Matrix, list[str]]:
    """Return the vectors of the received messages, (k, n), and the names of their entries."""
    names, columns = rows.dtype.names or (), ["x"]
    if table == SENSOR_ACKNOWLEDGEMENT:
        columns = []
    elif RECEIVES[OWNER[table]] is Flow.ACTUATION:
        columns = [column for column in ("u", "predicted", "x_c") if column in names]
    elif "y" in names:
        columns = ["y", "u_applied"]
    vectors = np.hstack([np.zeros((len(rows), 0)), *(rows[column] for column in columns)])
    return vectors, [
        entry for column in columns for entry in entry_names(column, rows[column].shape[1])
    ]


def _settings(data: bytes) -> dict[str, Any]:
    """Return the changes of settings without the invalid ones of a damaged record."""
    try:
        return settings_of(data)
    except ValueError:
        return {"": None}
