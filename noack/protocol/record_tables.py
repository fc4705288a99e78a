"""The tables of the numeric record, each with its columns; one row per input of a machine.

A machine emits its rows as :class:`noack.protocol.roles.Record`, in the order of the
columns here; live runs, simulation and replay fill the same tables. Everything else follows from
:data:`TABLES`: row types, Parquet files, the processes' tables, the description in
``docs/record.md``. Times are nanoseconds of simulated time since the run's epoch: ``t_ns`` is
nominal, ``now_ns`` actual.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import astuple, dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from netem.core.packet_rows import NETEM_PACKET, NETEM_RELEASE, PACKET_HEAD_BYTES, Fate
from noack.protocol.wire_format import Flow

PLANT_STEP = "plant_step"
PLANT_ACTUATION = "plant_actuation"
SENSOR_MEASUREMENT = "sensor_measurement"
CONTROLLER_STEP = "controller_step"
CONTROLLER_DELIVERY = "controller_delivery"
SENSOR_ACKNOWLEDGEMENT = "sensor_acknowledgement"
SENSOR_SETTING = "sensor_setting"
NETEM_SETTING = "netem_setting"
CONTROLLER_SETTING = "controller_setting"

STEP_TABLES = {
    "plant": PLANT_STEP,
    "sensor": SENSOR_MEASUREMENT,
    "netem": NETEM_PACKET,
    "controller": CONTROLLER_STEP,
}
"""By process: the table with a row for each of its regular steps; for netem, each datagram."""
SETTINGS = (SENSOR_SETTING, NETEM_SETTING, CONTROLLER_SETTING)
"""Tables of the changes of settings that each process received during the run."""
CHANGE_BYTES = 1024  # width of a change in the record: JSON, padded with zero bytes

LOOP = "loop"
"""First column of the tables of plant, sensor and controller: the number of the loop."""

NO_SEQUENCE = -1  # stands for "none" in a column of sequence numbers


def entry_names(vector: str, entries: int) -> tuple[str, ...]:
    """Names of a vector's entries, counted from 1: ``x_1``, ``x_2`` and so on.

    They are the columns of the Parquet files, and the names of states and inputs without names.
    """
    return tuple(f"{vector}_{i}" for i in range(1, entries + 1))


@dataclass(frozen=True)
class RecordShape:
    """The sizes of a run's vectors; a column of size 0 is not in the record."""

    n: int  # states
    m: int  # inputs
    acknowledged: bool = False  # whether updates are acknowledged
    carries_model: bool = False  # whether actuations carry the controller's model state
    predictions: int = 1  # inputs in an actuation
    internal: int = 0  # entries of the plant's own state z
    disturbed_input: bool = False
    disturbed_state: bool = False
    outputs: int = 0
    """Measured outputs from which an observer estimates the state; 0 without an observer."""
    inputs_reported: int = 0  # numbers of a measurement that are inputs


class Column(NamedTuple):
    """A column of a table."""

    name: str
    unit: str  # empty: a number without unit
    meaning: str
    entries: Callable[[RecordShape], int] | None = None
    """Length of a vector; None for a single number."""
    dtype: str = "<i8"
    exists: Callable[[RecordShape], bool] = lambda shape: True


def _vector(name: str, entries: Callable[[RecordShape], int], meaning: str) -> Column:
    return Column(name, "model units", meaning, entries, "<f8")


def _state(name: str, meaning: str) -> Column:
    return _vector(name, lambda shape: shape.n, meaning)


def _input(name: str, meaning: str) -> Column:
    return _vector(name, lambda shape: shape.m, meaning)


def _real(name: str, meaning: str) -> Column:
    return Column(name, "model units", meaning, None, "<f8")


def _bytes(name: str, width: int, meaning: str) -> Column:
    return Column(name, "bytes", meaning, None, f"V{width}")


class Table(NamedTuple):
    """A table of the record."""

    name: str
    owner: str  # the process that fills it
    row: str  # what one row stands for
    columns: tuple[Column, ...]  # besides ``COMMON``
    exists: Callable[[RecordShape], bool] = lambda shape: True


COMMON = (
    Column("input", "", "number of the machine's input, in order over all its tables"),
    Column("sequence", "", "sequence number of the message, or number of the step"),
    Column("t_ns", "ns", "nominal time: when the step or message was due"),
    Column("now_ns", "ns", "actual time"),
)
"""The first columns of every table."""

_MODEL_TIME = Column("model_t_ns", "ns", "time of the controller's model")
_CHANGE = (
    Column(
        "since_ns",
        "ns",
        "from when on the change is in force in this process: T, or later if it was received too late",
    ),
    _bytes("change", CHANGE_BYTES, "the settings by their keys, as JSON, padded with zero bytes"),
)


TABLES = (
    Table(PLANT_STEP, "plant", "step of the plant", (
        _state("x", "state at `t_ns`"),
        _input("u", "applied input from `t_ns` on"),
        Column("actuation", "", "sequence number of the newest actuation; u is its input unless "
               "the watchdog replaced it"),
        Column("entry", "", "number of the input in that actuation, from 0; −1: the watchdog's "
               "input; with `controller.predictions` only",
               exists=lambda shape: shape.predictions > 1),
        _vector("z", lambda shape: shape.internal,
                "the system's own state, for a system with more states than x"),
        _vector("d", lambda shape: shape.m * shape.disturbed_input,
                "disturbance added to the input, where there is one"),
        _vector("w", lambda shape: shape.n * shape.disturbed_state,
                "disturbance added to ẋ, where there is one"),
    )),
    Table(PLANT_ACTUATION, "plant", "actuation received by the plant; `t_ns` is the model time of "
          "its input", (
        _input("u", "input"),
        _vector("predicted", lambda shape: shape.m * (shape.predictions - 1),
                "inputs for the following ticks, with `controller.predictions` only"),
        _vector("x_c", lambda shape: shape.n * shape.carries_model,
                "the model's state, with `plant.watchdog.policy = \"model\"` only"),
    )),
    Table(SENSOR_MEASUREMENT, "sensor", "measurement received by the sensor", (
        _state("x", "measured state, or x̂ of the observer"),
        _state("x_s", "the sensor's model, before a reset"),
        _real("e_s_norm", "‖W(x_s − x)‖"),
        _real("compared", "left side of the trigger's comparison, ‖W(x_s − x)‖ for the paper's "
              "trigger"),
        _real("threshold", "right side; an event happens if the left side exceeds it, or when a "
              "timer of the trigger expires"),
        Column("event", "", "sequence number of the update that was sent, −1 for none"),
        _vector("y", lambda shape: shape.outputs,
                "measured outputs, with an observer only"),
        _vector("u_applied", lambda shape: shape.inputs_reported if shape.outputs else 0,
                "inputs applied in the plant's steps since the last measurement, in order, with an "
                "observer only"),
    )),
    Table(CONTROLLER_DELIVERY, "controller", "update received by the controller; `t_ns` is the "
          "event's time", (
        _MODEL_TIME,
        _state("x", "received state"),
        _state("x_c_before", "the model before the reset"),
        _state("x_c", "the model after the reset"),
        Column("dropouts", "", "updates missing before this one"),
    )),
    Table(CONTROLLER_STEP, "controller", "tick of the controller", (
        _MODEL_TIME,
        _state("x_c", "the model"),
        _input("u", "the controller's output, by default K x_c, or K(x_c − x_r) + u_r with a set "
               "point; the safe input while the controller has no state"),
    )),
    Table(NETEM_PACKET, "netem", "datagram received by the network emulator; `sequence` counts "
          "the datagrams of its flow, `t_ns` is the arrival at the socket if it is known, else "
          "`now_ns`", (
        Column("flow", "", "source: 0 the sensor; 1 the controller, if acknowledgements or "
               "actuations cross the network"),
        Column("fate", "", ", ".join(f"{fate.value} {fate.name.lower()}" for fate in Fate)),
        Column("consecutive_losses", "", "consecutive datagrams up to this one that were not "
               "effectively delivered, as known then"),
        Column("release_ns", "ns", "time at which it is to leave, −1 never; if a queue chooses "
               "what it sends, the earliest time"),
        Column("copy_ns", "ns", "time at which its copy is to leave, −1 never"),
        Column("bit", "", "number of the flipped bit, −1 none"),
        Column("size_bytes", "bytes", "size of the datagram"),
        _bytes("head", PACKET_HEAD_BYTES, "its leading bytes, not interpreted"),
    )),
    Table(NETEM_RELEASE, "netem", "delayed datagram, or copy, that left the network emulator; "
          "`sequence` as in `netem_packet`", (
        Column("flow", "", "as in `netem_packet`"),
        Column("copy", "", "1 for a copy"),
        Column("stale", "", "1 if a newer datagram of the flow had left before"),
    )),
    Table(SENSOR_SETTING, "sensor", "change of settings received by the sensor; `sequence` numbers "
          "the changes, `t_ns` is T", _CHANGE),
    Table(NETEM_SETTING, "netem", "change of settings received by the network emulator", _CHANGE),
    Table(CONTROLLER_SETTING, "controller", "change of settings received by the controller",
          _CHANGE),
    Table(SENSOR_ACKNOWLEDGEMENT, "sensor", "acknowledgement received by the sensor, with "
          "`network.protocol = \"ack\"` only; `sequence` and `t_ns` of the update", (
        Column("model_t_ns", "ns", "time of the sensor's model, that of the last measurement"),
        _state("x_s_before", "the model before the reset"),
        _state("x_s", "the model after the reset"),
    ), lambda shape: shape.acknowledged),
)  # fmt: skip

OWNER: Mapping[str, str] = {table.name: table.owner for table in TABLES}
"""The process that fills each table."""


def largest(shapes: Iterable[RecordShape]) -> RecordShape:
    """Return the largest of each size."""
    return RecordShape(*map(max, zip(*map(astuple, shapes), strict=True)))


@lru_cache
def tables(n: int, m: int, **sizes: int) -> Mapping[str, np.dtype[np.void]]:
    """Return the row types of a loop's tables; ``sizes`` has further sizes of `RecordShape`."""
    shape = RecordShape(n, m, **sizes)  # type: ignore[arg-type]
    return {
        table.name: np.dtype([*_fields((*COMMON, *table.columns), shape)])
        for table in TABLES
        if table.exists(shape)
    }


def _fields(columns: tuple[Column, ...], shape: RecordShape) -> list[tuple[object, ...]]:
    fields: list[tuple[object, ...]] = []
    for column in columns:
        if not column.exists(shape):
            continue
        if column.entries is None:
            fields.append((column.name, column.dtype))
        elif (entries := column.entries(shape)) > 0:
            fields.append((column.name, column.dtype, (entries,)))
    return fields


def network_tables() -> Mapping[str, np.dtype[np.void]]:
    """Return the row types of the tables of the network, which do not depend on the scenario."""
    return {table: dtype for table, dtype in tables(1, 1).items() if OWNER[table] == "netem"}


def is_of_network(table: str) -> bool:
    """Whether a table has the rows of the network, which its loops share."""
    return OWNER[table] == "netem"


UPDATES, ACKNOWLEDGEMENTS, ACTUATIONS = 0, 1, 1
"""The network emulator's directions: from the sensor; from the controller, which sends
acknowledgements or actuations through the network, or neither."""


def direction_of(flow: Flow) -> int:
    """The number of the direction of a flow that crosses the network."""
    return UPDATES if flow is Flow.UPDATE else ACTUATIONS
