"""Fate traces that are damaged or not written by an emulator give one error line."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from netem.fates import METADATA, read_fates
from noack.core.errors import CallerError
from tests.fuzz.parsers.fates import DOCUMENT, TABLE


def write(path: Path, table: pa.Table, document: object = DOCUMENT) -> Path:
    pq.write_table(table.replace_schema_metadata({METADATA: json.dumps(document)}), path)
    return path


def refused(path: Path) -> str:
    with pytest.raises(CallerError) as caught:
        read_fates(path)
    line = str(caught.value)
    assert line.startswith(f"{path}")
    assert "\n" not in line
    return line


def with_values(column: str, values: Callable[[list[Any]], list[Any]]) -> pa.Table:
    at = TABLE.column_names.index(column)
    field = TABLE.schema.field(at)
    return TABLE.set_column(at, field, pa.array(values(TABLE[column].to_pylist()), field.type))


def test_other_files_are_refused(tmp_path: Path) -> None:
    assert len(read_fates(write(tmp_path / "a", TABLE)).decisions["up", "forward"]) == 2
    assert re.search(r"cannot be read \(.*No such file", refused(tmp_path / "none"))
    assert "cannot be read" in refused(tmp_path)
    (tmp_path / "a").write_text("fates")
    assert "not a fate trace, or incomplete" in refused(tmp_path / "a")
    pq.write_table(pa.table({"a": [1]}), tmp_path / "a")
    assert "not a fate trace of this program" in refused(tmp_path / "a")
    other = write(tmp_path / "a", TABLE, {"format": 9, "version": "9.9"})
    assert "has the format of noack 9.9; record it again" in refused(other)


@pytest.mark.parametrize(
    "document",
    [
        None, *({k: v for k, v in DOCUMENT.items() if k != key} for key in DOCUMENT),
        DOCUMENT | {"missing_events": "0"}, DOCUMENT | {"missing_events": -1},
        DOCUMENT | {"links": [DOCUMENT["links"][0] | {"reverse": {}}]},
        DOCUMENT | {"links": [DOCUMENT["links"][0] | {"reverse": {"mansd": 1_000_001}}]},
    ],
)  # fmt: skip
def test_a_trace_with_an_invalid_document_is_refused(document: object, tmp_path: Path) -> None:
    assert "not a fate trace of this program" in refused(write(tmp_path / "a", TABLE, document))


@pytest.mark.parametrize(
    ("column", "value"),
    [("fate", 9), ("delay_ns", -5), ("delay_ns", 2**62 + 1), ("copy_delay_ns", 2**62 + 1),
     ("bit", -2), ("flow", -1), ("flow", 10**12), ("copy_bit", -3)],
)  # fmt: skip
def test_an_impossible_decision_is_refused(column: str, value: int, tmp_path: Path) -> None:
    table = with_values(column, lambda values: [value, *values[1:]])
    line = refused(write(tmp_path / "a", table))
    assert "impossible decision: " in line
    assert f"{column} {value}" in line


def test_a_missing_or_repeated_packet_or_value_is_refused(tmp_path: Path) -> None:
    for packets, message in (([0, 3], "expected packet 1, found 2"), ([0, 0], "found 0")):
        line = refused(write(tmp_path / "a", TABLE.take(packets)))
        assert "up forward: flow 0: expected packet 1" in line
        assert f"{message}; an incomplete trace" in line
    table = with_values("delay_ns", lambda values: [*values[:-1], None])
    assert "an incomplete trace cannot be replayed" in refused(write(tmp_path / "a", table))
