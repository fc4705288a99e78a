"""The tables of the numeric record: one row per input of a machine, defined once for all.

Every machine emits its rows as :class:`noack.machine.Record`; live runs, simulation and replay
fill the same tables. ``docs/record.md`` documents the columns for readers of the Parquet files.
Times are nanoseconds of simulated time since the run's epoch: ``t_ns`` is when something was due
(its nominal time), ``now_ns`` when it was done.
"""

from collections.abc import Mapping
from enum import IntEnum

import numpy as np
from numpy.typing import DTypeLike

PLANT_STEP = "plant_step"
PLANT_ACTUATION = "plant_actuation"
SENSOR_MEASUREMENT = "sensor_measurement"
CONTROLLER_STEP = "controller_step"
CONTROLLER_DELIVERY = "controller_delivery"
NETEM_PACKET = "netem_packet"

PACKET_HEAD_BYTES = 32
"""Leading bytes of each datagram that the network emulator keeps; it does not interpret them."""

NO_SEQUENCE = -1
"""Stands for "none" in a column of sequence numbers."""


class Fate(IntEnum):
    """What the network emulator did with a datagram."""

    DELIVERED = 0
    DROPPED = 1
    FORCED = 2
    """Delivered although the loss model said drop, because M−1 had just been dropped."""


def tables(n: int, m: int) -> Mapping[str, np.dtype[np.void]]:
    """Return the row types of all tables for ``n`` states and ``m`` inputs."""
    x: tuple[DTypeLike, tuple[int]] = ("<f8", (n,))
    u: tuple[DTypeLike, tuple[int]] = ("<f8", (m,))
    common = [("input", "<i8"), ("sequence", "<i8"), ("t_ns", "<i8"), ("now_ns", "<i8")]
    columns: dict[str, list[tuple[object, ...]]] = {
        PLANT_STEP: [*common, ("x", *x), ("u", *u), ("actuation", "<i8")],
        PLANT_ACTUATION: [*common, ("u", *u)],
        SENSOR_MEASUREMENT: [
            *common, ("x", *x), ("x_s", *x),
            ("e_s_norm", "<f8"), ("threshold", "<f8"), ("event", "<i8"),
        ],
        CONTROLLER_DELIVERY: [
            *common, ("model_t_ns", "<i8"), ("x", *x), ("x_c_before", *x), ("x_c", *x),
            ("dropouts", "<i8"),
        ],
        CONTROLLER_STEP: [*common, ("model_t_ns", "<i8"), ("x_c", *x), ("u", *u)],
        NETEM_PACKET: [
            *common, ("flow", "<i8"), ("fate", "<i8"), ("drop_run", "<i8"),
            ("size_bytes", "<i8"), ("head", f"V{PACKET_HEAD_BYTES}"),
        ],
    }  # fmt: skip
    return {table: np.dtype(fields) for table, fields in columns.items()}


OWNER: Mapping[str, str] = {
    PLANT_STEP: "plant",
    PLANT_ACTUATION: "plant",
    SENSOR_MEASUREMENT: "sensor",
    CONTROLLER_STEP: "controller",
    CONTROLLER_DELIVERY: "controller",
    NETEM_PACKET: "netem",
}
"""Which process fills which table."""
