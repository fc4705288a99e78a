"""ROS 2 messages of a loop: their types, their topics, and their bytes (CDR).

Every topic has the type ``sensor_msgs/msg/JointState``: a standard message with a stamp, names, and
numbers, which ROS, RViz, PlotJuggler and Foxglove know without a definition from noack. ``name``
has the names of the entries, ``position`` their values, ``header.frame_id`` the name of the loop;
``velocity`` and ``effort`` are empty. The library rosbags has the definitions and encodes.
"""

import re
from collections.abc import Iterator, Sequence
from functools import cache
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from noack.extend import CONTROLLER_DELIVERY, NS_PER_S, PLANT_STEP, SENSOR_MEASUREMENT, one_line

if TYPE_CHECKING:
    from rosbags.typesys.store import Msg, Typestore

JOINT_STATE, LOG = "sensor_msgs/msg/JointState", "rcl_interfaces/msg/Log"
_LATEST_NS = (2**31 - 1) * NS_PER_S
DEFAULT_ROUTER = "tcp/127.0.0.1:7447"
"""Default address of the router of rmw_zenoh, as zenoh writes it."""
TOPICS = {
    PLANT_STEP: ("state", "input"),
    CONTROLLER_DELIVERY: ("update",),
    SENSOR_MEASUREMENT: ("event",),
}
"""The topics of the rows of a table, below the loop's namespace."""


class Entries(NamedTuple):
    """Named numbers at a time: the content of a ``JointState``."""

    stamp_ns: int
    names: Sequence[str]
    values: NDArray[np.float64]


class _Header(Protocol):
    stamp: "_Time"


class _Time(Protocol):
    sec: int
    nanosec: int


class _JointState(Protocol):
    header: _Header
    name: Sequence[str]
    position: NDArray[np.float64]


@cache
def _store() -> "Typestore":
    from rosbags.typesys import Stores, get_typestore  # slow to import

    return get_typestore(Stores.ROS2_JAZZY)


def definition(kind: str) -> str:
    """Return the definition of a message type with those that it uses, as MCAP has it."""
    return _store().generate_msgdef(kind, ros_version=2)[0]


def type_hash(kind: str) -> str:
    """Return the hash of a message type (REP 2011), which both ends of a topic must have."""
    return _store().hash_rihs01(kind)


def joint_state(entries: Entries, frame: str) -> bytes:
    """Return the bytes of a ``JointState``."""
    types, none = _store().types, np.zeros(0)
    header = types["std_msgs/msg/Header"](stamp=_time(entries.stamp_ns), frame_id=frame)
    message = types[JOINT_STATE](
        header=header,
        name=[*entries.names],
        position=np.asarray(entries.values, np.float64),
        velocity=none,
        effort=none,
    )
    return bytes(_store().serialize_cdr(message, JOINT_STATE))


def log_line(stamp_ns: int, level: int, process: str, text: str) -> bytes:
    """Return the bytes of a ``Log``, the message of the topic ``/rosout``."""
    message = _store().types[LOG](
        stamp=_time(stamp_ns), level=level, name=process, msg=text, file="", function="", line=0
    )
    return bytes(_store().serialize_cdr(message, LOG))


def read_joint_state(data: bytes) -> Entries:
    """Return the content of a ``JointState``.

    Raises:
        ValueError: the bytes are none.
    """
    from rosbags.serde import SerdeError  # slow to import

    try:
        message: _JointState = _store().deserialize_cdr(data, JOINT_STATE)  # type: ignore[assignment]
    except Exception as error:  # the library raises many kinds for bytes that are no message
        text = str(error) if isinstance(error, SerdeError) else "its bytes end early, or are damaged"
        raise ValueError(one_line(f"not a {JOINT_STATE}: {text}")) from None
    stamp = message.header.stamp
    values = np.array(message.position, dtype=np.float64)
    return Entries(stamp.sec * NS_PER_S + stamp.nanosec, tuple(message.name), values)


def _time(t_ns: int) -> "Msg":
    """Return a time, or the nearest one that the message can have."""
    seconds, nanoseconds = divmod(min(max(t_ns, 0), _LATEST_NS), NS_PER_S)
    return _store().types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)


def name_part(text: str) -> str:
    """Return a text as a part of a name in ROS 2: letters, digits and ``_``."""
    part = re.sub("[^A-Za-z0-9_]", "_", text)
    return f"_{part}" if part[:1].isdigit() else part


def namespace(loop: str, *, is_only: bool) -> str:
    """Return the namespace of a loop's topics: ``/noack``, or ``/noack/LOOP`` among several."""
    return "/noack" if is_only else f"/noack/{name_part(loop)}"


def row_entries(
    table: str, rows: NDArray[np.void], states: Sequence[str], inputs: Sequence[str]
) -> Iterator[tuple[int, str, Entries]]:
    """Yield the messages of the rows of a table: number of the row, topic, and content.

    State and input are those of each step of the plant, an update is the state that the controller
    received, stamped with the time of its event. An event is a measurement at which the sensor
    sent an update.

    Args:
        table: a key of :data:`TOPICS`.
        rows: rows of one loop.
        states: names of the states.
        inputs: names of the inputs.
    """
    is_event = rows["event"] >= 0 if table == SENSOR_MEASUREMENT else np.ones(len(rows), np.bool_)
    for row_index in np.flatnonzero(is_event).tolist():
        row = rows[row_index]
        t_ns = int(row["t_ns"])
        if table == SENSOR_MEASUREMENT:
            columns = ("event", "e_s_norm", "compared", "threshold")
            values = np.array([float(row[name]) for name in columns])
            yield row_index, "event", Entries(t_ns, columns, values)
            continue
        x = row["x"][: len(states)]
        yield row_index, TOPICS[table][0], Entries(t_ns, states, x)
        if table == PLANT_STEP:
            yield row_index, "input", Entries(t_ns, inputs, row["u"][: len(inputs)])
