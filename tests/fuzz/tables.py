"""Faulty Parquet tables: wrong types, missing values, unusual numbers, damaged bytes."""

import io
from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tests.fuzz.choices import INTEGERS, Choices

_IN_64_BITS = [number for number in INTEGERS if -(2**63) <= number < 2**63]


def edited_table(choices: Choices, table: pa.Table) -> pa.Table:
    """Return a copy of a table with some edits."""
    for _ in range(choices.below(4)):
        name = choices.one(table.column_names) if table.num_columns else ""
        at = table.schema.get_field_index(name)
        if at < 0:
            break
        match choices.below(8):
            case 0:
                table = table.drop_columns([name])
            case 1:
                table = table.set_column(at, name, _other_type(choices, len(table)))
            case 2:
                table = table.append_column(name, table.column(at))
            case 3:
                table = table.slice(choices.below(len(table) + 1), choices.below(len(table) + 1))
            case 4:
                table = pa.concat_tables([table, table.slice(0, choices.below(len(table) + 1))])
            case _:
                table = table.set_column(
                    at, table.schema.field(at), _one_changed(choices, table[at])
                )
    return table


def written(choices: Choices, table: pa.Table, metadata: Mapping[str, str]) -> bytes:
    """Return the bytes of a Parquet file, some of them changed."""
    buffer = io.BytesIO()
    pq.write_table(table.replace_schema_metadata(dict(metadata)), buffer, compression="none")
    return damaged(choices, buffer.getvalue())


def damaged(choices: Choices, data: bytes) -> bytes:
    """Return the bytes with some of them changed, or truncated."""
    changed = bytearray(data)
    match choices.below(8):
        case 0:
            return bytes(changed[: choices.below(len(changed) + 1)])
        case 1:
            for _ in range(1 + choices.below(8)):
                # Counted from the end, where Parquet stores its metadata.
                changed[-1 - choices.below(min(len(changed), 2**16))] = choices.below(256)
    return bytes(changed)


def _other_type(choices: Choices, length: int) -> pa.Array:
    match choices.below(7):
        case 0:
            return pa.array([choices.text()] * length)
        case 1:
            return pa.nulls(length)
        case 2:
            return pa.array(np.full(length, choices.real()))
        case 3:
            return pa.array([b"\0" * choices.below(40)] * length)
        case 4:
            return pa.array([[1, 2]] * length, pa.list_(pa.int64()))
        case 5:
            return pa.array(np.full(length, choices.below(2), np.uint64) * np.uint64(2**64 - 1))
        case _:
            return pa.array(np.zeros(length, "datetime64[ns]"))


def _one_changed(choices: Choices, column: pa.ChunkedArray) -> Any:
    values = column.to_pylist()
    if not values:
        return column
    at = choices.below(len(values))
    value: Any = None
    if choices.below(8):
        if pa.types.is_integer(column.type):
            value = choices.one(_IN_64_BITS) if choices.flag() else choices.below(256) - 128
        elif pa.types.is_floating(column.type):
            value = choices.real()
        elif pa.types.is_dictionary(column.type):
            value = choices.one(["forward", "reverse", "up", "", "other"])
        elif isinstance(values[at], bytes):
            value = bytes(damaged(choices, values[at])).ljust(len(values[at]), b"\0")
    values[at] = value
    try:
        return pa.array(values, column.type)
    except (pa.ArrowInvalid, OverflowError, TypeError):
        return column
