"""A run as a folder of CSV files, one per table."""

import io
from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa
from pyarrow import csv

from cosim.output.export.export_formats import ExportedRun
from cosim.record.data_frames import events, samples, with_outputs, with_seconds
from cosim.record.run_directory import write_output
from cosim.record.table_files import arrow_table

SUFFIX = ""


def write(run: ExportedRun, folder: Path, *, certificates: bool = True) -> list[Path]:
    """Write the tables of a run, its samples and its events; a loop has a folder of its name.

    Raises:
        MachineError: a file cannot be written.
    """
    written = []
    for name, table in _tables(run):
        buffer = io.BytesIO()
        csv.write_csv(_with_hex(table), buffer)
        written.append(write_output(folder / f"{name}.csv", buffer.getvalue()))
    for loop in run.loops:
        written += write(loop, folder / loop.name)
    return written


def _tables(run: ExportedRun) -> Iterator[tuple[str, pa.Table]]:
    for name in run.record.tables:
        table = with_seconds(arrow_table(run.record[name]))
        yield name, table if run.record.is_network else with_outputs(table, run.record.scenario)
    if not run.record.is_network:
        yield "samples", samples(run.record)
        yield "events", events(run.record)


def _with_hex(table: pa.Table) -> pa.Table:
    """Return a table with bytes as hexadecimal text."""
    for i, field in enumerate(table.schema):
        if pa.types.is_fixed_size_binary(field.type):
            texts = [(value or b"").hex() for value in table.column(i).to_pylist()]
            table = table.set_column(i, field.name, pa.array(texts, pa.string()))
    return table
