"""The tables of the numeric record: one row per input of a machine, defined once for all.

Every machine emits its rows as :class:`noack.protocol.machine_interface.Record`; live runs,
simulation and replay fill the same tables. ``docs/record.md`` documents the columns for readers of
the Parquet files. Times are nanoseconds of simulated time since the run's epoch: ``t_ns`` is when
something was due (its nominal time), ``now_ns`` when it was done.
"""

from collections.abc import Mapping
from enum import IntEnum

import numpy as np
from numpy.typing import DTypeLike, NDArray

PLANT_STEP = "plant_step"
PLANT_ACTUATION = "plant_actuation"
SENSOR_MEASUREMENT = "sensor_measurement"
CONTROLLER_STEP = "controller_step"
CONTROLLER_DELIVERY = "controller_delivery"
SENSOR_ACKNOWLEDGEMENT = "sensor_acknowledgement"
NETEM_PACKET = "netem_packet"
NETEM_RELEASE = "netem_release"
SENSOR_SETTING = "sensor_setting"
NETEM_SETTING = "netem_setting"
CONTROLLER_SETTING = "controller_setting"

SETTINGS = (SENSOR_SETTING, NETEM_SETTING, CONTROLLER_SETTING)
"""What each process was told of changes during the run."""
CHANGE_BYTES = 1024
"""Width of a change in the record: JSON, filled up with zeros."""

PACKET_HEAD_BYTES = 32
"""Leading bytes of each datagram that the network emulator keeps; it does not interpret them."""

NO_SEQUENCE = -1
"""Stands for "none" in a column of sequence numbers."""


class Fate(IntEnum):
    """What the network emulator did with a datagram."""

    DELIVERED = 0
    DROPPED = 1
    FORCED = 2
    """Delivered although an impairment said no, as M − 1 in a row had not been delivered."""
    CORRUPTED = 3
    """Sent on with a flipped bit."""
    OVERFLOWED = 4
    """Dropped from a full queue."""
    BLACKED_OUT = 5
    """Dropped during a blackout."""

    @property
    def effective(self) -> bool:
        """Whether the datagram was effectively delivered, unless a later one overtook it."""
        return self in (Fate.DELIVERED, Fate.FORCED)


def effective(fates: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether each datagram was effectively delivered, unless a later one overtook it, (k,)."""
    return np.isin(fates, [fate for fate in Fate if fate.effective])


def entry_names(vector: str, entries: int) -> tuple[str, ...]:
    """Names of a vector's entries, counted from 1: ``x_1``, ``x_2`` and so on.

    They are the columns of the record, and what states and inputs are called that have no names.
    """
    return tuple(f"{vector}_{i}" for i in range(1, entries + 1))


def tables(
    n: int,
    m: int,
    *,
    acknowledged: bool = False,
    predictive: bool = False,
    internal: int = 0,
    disturbed_input: bool = False,
    disturbed_state: bool = False,
    outputs: int = 0,
    inputs_reported: int = 0,
) -> Mapping[str, np.dtype[np.void]]:
    """Return the row types of all tables for ``n`` states and ``m`` inputs.

    Args:
        n: number of states.
        m: number of inputs.
        acknowledged: whether updates are acknowledged, so that there is a table of that, too.
        predictive: whether actuations carry the controller's model state.
        internal: number of entries of the plant's own state z that are on record.
        disturbed_input: whether something is added to the plant's input.
        disturbed_state: whether something is added to its ẋ.
        outputs: number of measured outputs from which an observer estimates the state; 0 if there
            is no observer.
        inputs_reported: how many numbers of a measurement are inputs.
    """
    x: tuple[DTypeLike, tuple[int]] = ("<f8", (n,))
    u: tuple[DTypeLike, tuple[int]] = ("<f8", (m,))
    common = [("input", "<i8"), ("sequence", "<i8"), ("t_ns", "<i8"), ("now_ns", "<i8")]
    columns: dict[str, list[tuple[object, ...]]] = {
        PLANT_STEP: [*common, ("x", *x), ("u", *u), ("actuation", "<i8")],
        PLANT_ACTUATION: [*common, ("u", *u)],
        SENSOR_MEASUREMENT: [
            *common, ("x", *x), ("x_s", *x),
            ("e_s_norm", "<f8"), ("compared", "<f8"), ("threshold", "<f8"), ("event", "<i8"),
        ],
        CONTROLLER_DELIVERY: [
            *common, ("model_t_ns", "<i8"), ("x", *x), ("x_c_before", *x), ("x_c", *x),
            ("dropouts", "<i8"),
        ],
        CONTROLLER_STEP: [*common, ("model_t_ns", "<i8"), ("x_c", *x), ("u", *u)],
        NETEM_PACKET: [
            *common, ("flow", "<i8"), ("fate", "<i8"), ("drop_run", "<i8"),
            ("release_ns", "<i8"), ("copy_ns", "<i8"), ("bit", "<i8"),
            ("size_bytes", "<i8"), ("head", f"V{PACKET_HEAD_BYTES}"),
        ],
        NETEM_RELEASE: [*common, ("flow", "<i8"), ("copy", "<i8"), ("stale", "<i8")],
    }  # fmt: skip
    for table in SETTINGS:
        columns[table] = [*common, ("since_ns", "<i8"), ("change", f"V{CHANGE_BYTES}")]
    if internal:
        columns[PLANT_STEP].append(("z", "<f8", (internal,)))
    if disturbed_input:
        columns[PLANT_STEP].append(("d", *u))
    if disturbed_state:
        columns[PLANT_STEP].append(("w", *x))
    if outputs:
        columns[SENSOR_MEASUREMENT] += [
            ("y", "<f8", (outputs,)), ("u_felt", "<f8", (inputs_reported,)),
        ]  # fmt: skip
    if predictive:
        columns[PLANT_ACTUATION].append(("x_c", *x))
    if acknowledged:
        columns[SENSOR_ACKNOWLEDGEMENT] = [
            *common, ("model_t_ns", "<i8"), ("x_s_before", *x), ("x_s", *x),
        ]  # fmt: skip
    return {table: np.dtype(fields) for table, fields in columns.items()}


OWNER: Mapping[str, str] = {
    PLANT_STEP: "plant",
    PLANT_ACTUATION: "plant",
    SENSOR_MEASUREMENT: "sensor",
    SENSOR_ACKNOWLEDGEMENT: "sensor",
    CONTROLLER_STEP: "controller",
    CONTROLLER_DELIVERY: "controller",
    NETEM_PACKET: "netem",
    NETEM_RELEASE: "netem",
    SENSOR_SETTING: "sensor",
    NETEM_SETTING: "netem",
    CONTROLLER_SETTING: "controller",
}
"""Which process fills which table; ``sensor_acknowledgement`` is not in every run."""

UPDATES, ACKNOWLEDGEMENTS = 0, 1
"""The network emulator's flows in a run: from the sensor, and from the controller."""
