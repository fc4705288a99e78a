"""A run as MCAP: one channel per table, messages as JSON with a JSON Schema.

Foxglove, PlotJuggler and the libraries of MCAP read it. The log time of a message is the actual
time of its row, its publish time the nominal one, both in simulated nanoseconds since the run's
epoch. Log times ascend in the file.

Beside it, a file of its own has ROS 2 messages (profile ``ros2``, CDR, with ``ros2msg`` schemas):
rosbags and ``ros2 bag`` read files in which every channel is of ROS 2. Log time, publish time and
topics are the same; the stamp in a message is its nominal time.
"""

import heapq
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray
from pydantic_core import to_json

from noack import ExportedRun
from noack.extend import COMMON, NS_PER_S, OWNER, TABLES, MachineError, new_file, why
from noack_ros2 import ros2_messages as ros2

Rows = NDArray[np.void]
SUFFIX = ".mcap"
_CHUNK_BYTES = 2**20
_SEQUENCE_MASK = 0xFFFF_FFFF  # MCAP's sequence numbers have 32 bits
_LEVELS = {"info": 2, "warning": 3, "error": 4}
"""Numbers of the levels of foxglove.Log."""
_ROSOUT = "/rosout"
ERRORS, LOG = "/loop/errors", "/log"
_SCHEMA_DIALECT = "https://json-schema.org/draft/2020-12/schema"
_HEX_PATTERN = "^([0-9a-f]{2})*$"
_REAL_TYPE: dict[str, object] = {"type": ["number", "null"]}  # null: not finite
_TABLES = {table.name: table for table in TABLES}
_SCHEMAS = json.loads(Path(__file__).with_name("mcap_schemas.json").read_bytes())
"""Schemas of the messages that are no rows of a table."""


class McapMessage(NamedTuple):
    """A message, with the arguments of the writer but its channel."""

    log_ns: int
    publish_ns: int
    topic: str
    content: bytes
    sequence: int


_ROS_SUFFIX = ".ros2.mcap"
_ROS_LEVELS = {"warning": 30, "error": 40}
_ROS_INFO = 20
"""Numbers of the levels of ROS 2; the second is that of all others."""


def write(run: ExportedRun, path: Path, *, certificates: bool = True) -> list[Path]:
    """Write a run as MCAP; the loops of a run of several have their names before their topics.

    A second file has ROS 2 messages: ``NAME.ros2.mcap``.

    Raises:
        MachineError: a file cannot be written.
    """
    file_path = path
    try:
        with new_file(path) as file:
            writer = Writer(file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
            writer.start(profile="", library="noack")
            _write_content(writer, run)
            writer.finish()  # type: ignore[no-untyped-call]
        file_path = path.with_suffix(_ROS_SUFFIX)
        _write_ros(run, file_path)
    except (OSError, ValueError) as error:
        raise MachineError(f"{file_path}: cannot be written: {why(error)}") from None
    return [path, file_path]


def _write_content(writer: Writer, run: ExportedRun) -> None:
    writer.add_metadata(
        "noack",
        {
            "scenario": run.scenario.name,
            "kind": str(run.environment["kind"]),
            "started": str(run.environment.get("started", "")),
            "time": "simulated nanoseconds since the epoch of the run",
        },
    )
    for name, media in (("scenario.toml", "application/toml"), ("summary.json", "application/json")):
        if (run.directory / name).is_file():
            writer.add_attachment(0, 0, name, media, (run.directory / name).read_bytes())
    channels: dict[str, int] = {}
    streams = [_log(run, channels, writer), _rows(run, [*run.tables], channels, writer)]
    for loop in run.loops:
        own = [table for table in loop.tables if OWNER[table] != "netem"]
        streams.append(_rows(loop, own, channels, writer))
    streams += [_errors(loop, channels, writer) for loop in run.loops or [run]]
    for message in _in_order(streams):
        _add(writer, channels[message.topic], message)


def _in_order(streams: Iterable[Iterator[McapMessage]]) -> Iterator[McapMessage]:
    """Yield the messages of several streams, each in the order of the log time, in this order."""
    return heapq.merge(*streams, key=lambda message: message.log_ns)


def _add(writer: Writer, channel: int, message: McapMessage) -> None:
    _, publish_ns, _, content, sequence = message
    writer.add_message(channel, message.log_ns, content, publish_ns, sequence)


def _register(
    writer: Writer, channels: dict[str, int], run: ExportedRun, topic: str, schema: dict[str, object]
) -> str:
    """Register a channel; return its topic."""
    schema_id = writer.register_schema(str(schema["title"]), "jsonschema", to_json(schema))
    names = {}
    if not run.is_network:
        states, inputs = run.names
        # A name may have a comma.
        names = {"states": json.dumps([*states], ensure_ascii=False)}
        names["inputs"] = json.dumps([*inputs], ensure_ascii=False)
    topic = f"/{run.name}{topic}" if run.name else topic
    channels[topic] = writer.register_channel(topic, "json", schema_id, names)
    return topic


def _rows(
    run: ExportedRun, tables: list[str], channels: dict[str, int], writer: Writer
) -> Iterator[McapMessage]:
    """Yield the rows of some tables in the order of their log time."""
    topics = {
        table: _register(writer, channels, run, _table_topic(table), _table_schema(table, run.tables[table]))
        for table in tables
    }
    for part in run.parts(*tables):
        yield from _in_order(
            [_rows_of_table(part[table], topic, run.phase_ns) for table, topic in topics.items()]
        )


def _rows_of_table(rows: Rows, topic: str, phase_ns: int) -> Iterator[McapMessage]:
    """Yield the rows of a table in the order of their log time; their times are those of the run."""
    names = rows.dtype.names or ()
    columns = {name: _column_reader(name, rows[name]) for name in names}
    for i in np.argsort(rows["now_ns"], kind="stable").tolist():
        content = {name: column(i) for name, column in columns.items()}
        log_ns, publish_ns = (max(int(rows[name][i]) + phase_ns, 0) for name in ("now_ns", "t_ns"))
        sequence = int(rows["sequence"][i]) & _SEQUENCE_MASK
        yield McapMessage(log_ns, publish_ns, topic, to_json(content, inf_nan_mode="null"), sequence)


def _column_reader(name: str, column: Rows) -> Callable[[int], object]:
    """Return a function that gives the entry of a row as a value for JSON."""
    if column.dtype.kind != "V":
        values = column.tolist()
        return lambda i: values[i]
    if name == "change":
        return lambda i: column[i].tobytes().rstrip(b"\0").decode(errors="replace")
    return lambda i: column[i].tobytes().hex()


def _log(run: ExportedRun, channels: dict[str, int], writer: Writer) -> Iterator[McapMessage]:
    """Yield the lines of the run's log as foxglove.Log."""
    if not run.notices:
        return
    topic = _register(writer, channels, run, LOG, _SCHEMAS["log"])
    for number, (t_ns, notice) in enumerate(_notices(run)):
        content = {
            "timestamp": {"sec": t_ns // NS_PER_S, "nsec": t_ns % NS_PER_S},
            "level": _LEVELS.get(notice["level"], 0),
            "message": notice["text"],
            "name": notice["process"],
            "file": "",
            "line": 0,
        }
        yield McapMessage(t_ns, t_ns, topic, to_json(content), number)


def _notices(run: ExportedRun) -> list[tuple[int, Mapping[str, Any]]]:
    """Return the lines of the run's log by ascending times."""
    notices = [(max(int(notice["t_ns"]), 0), notice) for notice in run.notices]
    return sorted(notices, key=lambda line: line[0])


def _errors(run: ExportedRun, channels: dict[str, int], writer: Writer) -> Iterator[McapMessage]:
    """Yield the norms of the errors at each measurement."""
    topic = _register(writer, channels, run, ERRORS, _SCHEMAS["errors"])
    columns = run.samples().select(("t_ns", "e_s_norm", "threshold", "e_c_norm")).sort_by("t_ns").to_pydict()
    for number, values in enumerate(zip(*columns.values(), strict=True)):
        content = to_json(dict(zip(columns, values, strict=True)), inf_nan_mode="null")
        at_ns = max(values[0] + run.phase_ns, 0)  # damaged records have others
        yield McapMessage(at_ns, at_ns, topic, content, number & _SEQUENCE_MASK)


# Topics and schemas


def _table_topic(table: str) -> str:
    """Return the topic of a table's messages: ``plant_step`` is ``/plant/step``."""
    owner = OWNER[table]
    return f"/{owner}/{table.removeprefix(f'{owner}_')}"


def _table_schema(table: str, rows: np.dtype[np.void]) -> dict[str, object]:
    """Return the JSON Schema of a table's messages; a vector is an array.

    Args:
        table: name of the table.
        rows: type of its rows in the run.
    """
    columns = {column.name: column for column in (*COMMON, *_TABLES[table].columns)}
    properties: dict[str, object] = {}
    for name in rows.names or ():
        unit = columns[name].unit
        text = columns[name].meaning + (f" [{unit}]" if unit else "")
        properties[name] = {**_json_type(name, rows[name]), "description": text}
    return {
        "$schema": _SCHEMA_DIALECT,
        "title": f"noack.{table}",
        "description": _TABLES[table].row,
        "type": "object",
        "properties": properties,
        "required": [*properties],
    }


def _json_type(name: str, field: np.dtype[np.generic]) -> dict[str, object]:
    """Return the JSON Schema of a column."""
    if field.kind == "V" and field.subdtype is None:
        return {"type": "string"} if name == "change" else {"type": "string", "pattern": _HEX_PATTERN}
    entry = _REAL_TYPE if field.base.kind == "f" else {"type": "integer"}
    if not field.shape:
        return dict(entry)
    size = field.shape[0]
    return {"type": "array", "items": entry, "minItems": size, "maxItems": size}


def _write_ros(run: ExportedRun, path: Path) -> None:
    """Write the file with ROS 2 messages. Raise OSError if that fails."""
    with new_file(path) as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="noack")
        loops = run.loops or [run]
        streams = [_joint_states(loop, is_only=len(loops) == 1) for loop in loops]
        bag = _Bag(writer)
        for message in _in_order([*streams, _rosout(run)]):
            bag.add(message)
        writer.finish()  # type: ignore[no-untyped-call]


class _Bag:
    """The topics of a file with ROS 2 messages, registered when their first message is written."""

    def __init__(self, writer: Writer) -> None:
        self._writer, self._channels, self._schemas = writer, dict[str, int](), dict[str, int]()

    def add(self, message: McapMessage) -> None:
        """Write a message."""
        topic = message.topic
        if topic not in self._channels:
            kind = ros2.LOG if topic == _ROSOUT else ros2.JOINT_STATE
            if kind not in self._schemas:
                content = ros2.definition(kind).encode()
                self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", content)
            profile = {"offered_qos_profiles": ""}
            self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schemas[kind], profile)
        _add(self._writer, self._channels[topic], message)


def _joint_states(run: ExportedRun, *, is_only: bool) -> Iterator[McapMessage]:
    """Yield the messages of a loop, in the order of the log time."""
    name = run.scenario.name
    prefix = ros2.namespace(run.name or name, is_only=is_only)
    for part in run.parts(*ros2.TOPICS):
        messages: list[McapMessage] = []
        for table in ros2.TOPICS:
            rows = part[table]
            for row, topic, entries in ros2.row_entries(table, rows, *run.names):
                log_ns = max(int(rows["now_ns"][row]) + run.phase_ns, 0)
                message_entries = entries._replace(stamp_ns=entries.stamp_ns + run.phase_ns)
                number = int(rows["sequence"][row]) & _SEQUENCE_MASK
                content = ros2.joint_state(message_entries, name)
                publish_ns = max(message_entries.stamp_ns, 0)
                messages.append(McapMessage(log_ns, publish_ns, f"{prefix}/{topic}", content, number))
        yield from sorted(messages, key=lambda message: message.log_ns)


def _rosout(run: ExportedRun) -> Iterator[McapMessage]:
    """Yield the lines of the run's log."""
    for number, (t_ns, notice) in enumerate(_notices(run)):
        level = _ROS_LEVELS.get(notice["level"], _ROS_INFO)
        line = ros2.log_line(t_ns, level, notice["process"], notice["text"])
        yield McapMessage(t_ns, t_ns, _ROSOUT, line, number)
