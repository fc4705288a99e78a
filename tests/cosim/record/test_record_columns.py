"""The tables and columns of the record agree with docs/record.md."""

from pathlib import Path

import pytest

from noack.protocol.record_tables import COMMON, TABLES, Column, Table

DOCS = Path(__file__).parents[3] / "docs" / "record.md"
TEXT = " ".join(DOCS.read_text(encoding="utf-8").split())


def markdown(columns: tuple[Column, ...]) -> str:
    lines = [f"| `{one.name}` | {one.unit} | {one.meaning} |" for one in columns]
    return " ".join(" ".join(["| column | unit | meaning |", "|---|---|---|", *lines]).split())


def test_the_docs_describe_the_common_columns() -> None:
    assert markdown(COMMON) in TEXT


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.name)
def test_the_docs_describe_every_table(table: Table) -> None:
    described = f"`{table.name}` ({table.owner}): one row per {table.row}. "
    assert described + markdown(table.columns) in TEXT
