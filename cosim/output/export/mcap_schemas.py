"""Topics and JSON Schemas of the messages of an MCAP file; they follow from the record's tables."""

from typing import Any

import numpy as np

from noack.protocol.record_tables import COMMON, OWNER, TABLES

ERRORS, LOG = "/loop/errors", "/log"
_DIALECT = "https://json-schema.org/draft/2020-12/schema"
_REAL: dict[str, Any] = {"type": ["number", "null"]}  # null: not finite
_TABLES = {table.name: table for table in TABLES}


def topic_of(table: str) -> str:
    """Return the topic of a table's messages: ``plant_step`` is ``/plant/step``."""
    owner = OWNER[table]
    return f"/{owner}/{table.removeprefix(f'{owner}_')}"


def schema_of(table: str, rows: np.dtype[np.void]) -> dict[str, Any]:
    """Return the JSON Schema of a table's messages; a vector is an array.

    Args:
        table: name of the table.
        rows: type of its rows in the run.
    """
    described = {column.name: column for column in (*COMMON, *_TABLES[table].columns)}
    properties: dict[str, Any] = {}
    for name in rows.names or ():
        unit = described[name].unit
        text = described[name].meaning + (f" [{unit}]" if unit else "")
        properties[name] = {**_type(name, rows[name]), "description": text}
    return _object(f"noack.{table}", _TABLES[table].row, properties)


def _type(name: str, field: np.dtype[Any]) -> dict[str, Any]:
    if field.kind == "V" and field.subdtype is None:
        return {"type": "string"} if name == "change" else {"type": "string", "pattern": _HEX}
    one = _REAL if field.base.kind == "f" else {"type": "integer"}
    if not field.shape:
        return dict(one)
    size = field.shape[0]
    return {"type": "array", "items": one, "minItems": size, "maxItems": size}


_HEX = "^([0-9a-f]{2})*$"


def _object(title: str, description: str, properties: dict[str, Any]) -> dict[str, Any]:
    return {
        "$schema": _DIALECT, "title": title, "description": description, "type": "object",
        "properties": properties, "required": [*properties],
    }  # fmt: skip


ERRORS_SCHEMA = _object(
    "noack.errors",
    "norms of the errors at a measurement",
    {
        "t_ns": {"type": "integer", "description": "time of the measurement [ns]"},
        "e_s_norm": {**_REAL, "description": "‖W(x_s − x)‖ before a reset"},
        "threshold": {**_REAL, "description": "value above which there is an event"},
        "e_c_norm": {**_REAL, "description": "‖W(x_c − x)‖; null without controller records"},
    },
)
_INTEGER, _TEXT = {"type": "integer"}, {"type": "string"}
LOG_SCHEMA = _object(
    "foxglove.Log",
    "a line of the run's log",
    {
        "timestamp": {
            "type": "object", "title": "time",
            "properties": {"sec": dict(_INTEGER), "nsec": dict(_INTEGER)},
        },
        "level": dict(_INTEGER), "message": dict(_TEXT), "name": dict(_TEXT),
        "file": dict(_TEXT), "line": dict(_INTEGER),
    },
)  # fmt: skip
