"""Structured inputs, whose choices Hypothesis draws; edits of content."""

import copy
import datetime
import io
import json
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from hypothesis import strategies as st

T = TypeVar("T")

INTEGERS = (
    0, 1, -1, 2, 3, 5, 64, 65, 255, 65_535, 65_536, 10**6, 10**9, 2**31, 2**53 + 1,
    2**63 - 1, 2**63, -(2**63), 2**64 - 1, 2**64, 10**30, 10**400,
)  # fmt: skip
FLOATS = (
    0.0, -0.0, 0.5, 1.0, -1.0, 1.5, 0.1, 100.0, 1e-9, 1e-3, 1e9, 1e17, 1e300,
    1.7976931348623157e308, 5e-324, float("inf"), float("-inf"), float("nan"),
)  # fmt: skip


class Choices:
    """Choices that Hypothesis draws, and reduces to the first option where an input fails."""

    def __init__(self, data: st.DataObject) -> None:
        self._draw = data.draw

    def more(self) -> bool:
        """Return whether a list of inputs goes on; 20 are the usual number."""
        return self.below(20) > 0

    def take(self, count: int) -> bytes:
        """Return ``count`` bytes."""
        return self._draw(st.binary(min_size=count, max_size=count))

    def junk(self) -> bytes:
        """Return any bytes."""
        return self._draw(st.binary(max_size=200))

    def near(self, seeds: Sequence[bytes], words: Sequence[bytes] = ()) -> bytes:
        """Return a text with some parts replaced by words, other bytes or parts of another text."""
        data, other = self.choose(seeds), self.choose(seeds)
        for _ in range(self.below(6)):
            begin, end = sorted((self.below(len(data) + 1), self.below(len(data) + 1)))
            match self.below(4):
                case 0 if words:
                    data = data[:begin] + self.choose(words) + data[begin:]
                case 1:
                    data = data[:begin] + other[self.below(len(other) + 1) :]
                case _:
                    data = data[:begin] + self._draw(st.binary(max_size=16)) + data[end:]
        return data

    def below(self, limit: int) -> int:
        """Return a number from 0 to ``limit`` − 1."""
        return self._draw(st.integers(0, limit - 1))

    def choose(self, options: Sequence[T]) -> T:
        """Return one of these options."""
        return options[self.below(len(options))]

    def flag(self) -> bool:
        """Return True or False."""
        return bool(self.below(2))

    def integer(self) -> int:
        """Return an integer: a boundary value, a small one, or any of 64 bits."""
        match self.below(3):
            case 0:
                return self.choose(INTEGERS)
            case 1:
                return self.below(256)
            case _:
                return self._draw(st.integers(-(2**63), 2**63 - 1))

    def real(self) -> float:
        """Return a float: a boundary value, or any 64 bits."""
        if self.flag():
            return self._draw(st.floats())
        return self.choose(FLOATS)

    def text(self) -> str:
        """Return a short text of any characters."""
        return self._draw(st.text(max_size=16))


NAMED: Mapping[str, bytes] = {
    "trace.txt": b"0100 1\n",
    "delays.txt": b"# delays\n0.01\n12.5ms\n",
    "table.dist": b"-8192 0 8192\n",
}
"""Files in the same folder as the input file."""


class Vocabulary(NamedTuple):
    """Keys and values that edits insert."""

    keys: Sequence[str]
    words: Sequence[str]
    dates: bool = False
    """Whether the format has dates and no null, as TOML does."""


def vocabulary(schema: Mapping[str, Any], *, dates: bool = False) -> Vocabulary:
    """Return the keys and constant strings of a JSON Schema, in order."""
    keys, words = dict[str, None](), dict[str, None]()
    parts: list[Any] = [schema]
    while parts:
        part = parts.pop(0)
        if isinstance(part, Mapping):
            keys |= dict.fromkeys(part.get("properties", {}))
            constants = [part.get("const"), part.get("default"), *part.get("enum", ())]
            words |= dict.fromkeys(constant for constant in constants if isinstance(constant, str))
            parts += part.values()
        elif isinstance(part, list):
            parts += part
    return Vocabulary(tuple(keys), tuple(words), dates)


def edited(choices: Choices, tree: Any, vocabulary: Vocabulary, most_edits: int = 6) -> Any:
    """Return a copy of a tree of dicts and lists with some edits."""
    root = {"": copy.deepcopy(tree)}
    for _ in range(choices.below(most_edits)):
        _edit(choices, root[""], vocabulary)
    return root[""]


def value(choices: Choices, vocabulary: Vocabulary, depth: int = 0) -> Any:
    """Return a value of any type."""
    match choices.below(9 if depth < 3 else 6):
        case 0:
            return choices.integer()
        case 1:
            return choices.real()
        case 2:
            return choices.flag()
        case 3:
            return choices.choose(vocabulary.words) if vocabulary.words else ""
        case 4:
            return choices.text()
        case 5:
            return datetime.date(1970, 1, 1) if vocabulary.dates else None
        case 6:
            return [value(choices, vocabulary, depth + 1) for _ in range(choices.below(4))]
        case 7:
            return {
                key(choices, vocabulary): value(choices, vocabulary, depth + 1)
                for _ in range(choices.below(4))
            }
        case _:
            nested: Any = value(choices, vocabulary, depth + 1)
            for _ in range(choices.below(20)):
                nested = [nested]
            return nested


def key(choices: Choices, vocabulary: Vocabulary) -> str:
    """Return a key of the format or any other key."""
    return choices.choose(vocabulary.keys) if vocabulary.keys and choices.below(8) else choices.text()


def _edit(choices: Choices, tree: Any, vocabulary: Vocabulary) -> None:
    containers = list(_containers(tree))
    if not containers:
        return
    container = choices.choose(containers)
    at: Any
    if isinstance(container, dict):
        at = choices.choose(list(container)) if container and choices.below(3) else key(choices, vocabulary)
    elif container:
        at = choices.below(len(container))
    else:
        container.append(value(choices, vocabulary))
        return
    match choices.below(5):
        case 0 | 1:
            container[at] = value(choices, vocabulary)
        case 2:
            container[at] = copy.deepcopy(choices.choose(containers))
        case 3 if isinstance(container, list):
            container.insert(at, copy.deepcopy(container[at]))
        case _ if isinstance(container, dict):
            container.pop(at, None)
        case _:
            del container[at]


def _containers(tree: Any) -> Any:
    """Return the tables and lists of a tree; of a long list, only the first entries."""
    if isinstance(tree, dict):
        yield tree
        for entry in tree.values():
            yield from _containers(entry)
    elif isinstance(tree, list):
        yield tree
        for entry in tree[:4]:
            yield from _containers(entry)


def write_named(folder: Path, name: str, data: bytes) -> Path:
    """Write a file into a folder, together with the files that it may name."""
    _named(folder)
    path = folder / name
    path.write_bytes(data)
    return path


@cache
def _named(folder: Path) -> None:
    for name, data in NAMED.items():
        (folder / name).write_bytes(data)


def bases(folder: str, *more: Mapping[str, Any]) -> Sequence[Mapping[str, Any]]:
    """Return the content of the shipped TOML files of a folder, and ``more``."""
    paths = sorted((Path(__file__).parents[2] / folder).glob("*.toml"))
    return [*(tomllib.loads(path.read_text(encoding="utf-8")) for path in paths), *more]


def quoted(vocabulary: Vocabulary) -> Sequence[bytes]:
    """Return plain keys, quoted words and some numbers, for a fuzzer that makes text."""
    words: Iterable[str] = (*vocabulary.keys, *(json.dumps(word) for word in vocabulary.words))
    return [word.encode() for word in (*words, "1e400", "nan", "-inf", "[[", "]]", "{", "}", "=")]


_IN_64_BITS = [number for number in INTEGERS if -(2**63) <= number < 2**63]


def edited_table(choices: Choices, table: pa.Table) -> pa.Table:
    """Return a copy of a table with some edits."""
    for _ in range(choices.below(4)):
        name = choices.choose(table.column_names) if table.num_columns else ""
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
                table = table.set_column(at, table.schema.field(at), _one_changed(choices, table[at]))
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
    changed: Any = None
    if choices.below(8):
        if pa.types.is_integer(column.type):
            changed = choices.choose(_IN_64_BITS) if choices.flag() else choices.below(256) - 128
        elif pa.types.is_floating(column.type):
            changed = choices.real()
        elif pa.types.is_dictionary(column.type):
            changed = choices.choose(["forward", "reverse", "up", "", "other"])
        elif isinstance(values[at], bytes):
            changed = bytes(damaged(choices, values[at])).ljust(len(values[at]), b"\0")
    values[at] = changed
    try:
        return pa.array(values, column.type)
    except (pa.ArrowInvalid, OverflowError, TypeError):
        return column
