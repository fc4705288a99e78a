"""A run, or certificates, as a file of MATLAB and Octave (``.mat``, version 5)."""

import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.certificates import certificates_of
from cosim.output.export.export_formats import ExportedRun
from cosim.record.data_frames import events, samples
from cosim.record.rows import Rows
from cosim.record.run_directory import write_output
from netem.core.errors import CallerError, MachineError
from noack.scenario.scenario import Scenario

SUFFIX = ".mat"
_LONGEST_NAME = 31  # of the format of version 5
_INVALID_CHARACTER = re.compile(r"\W", re.ASCII)


def write(run: ExportedRun, path: Path, *, certificates: bool = True) -> list[Path]:
    """Write a run: its tables, samples, events, summary, scenario and certificates, as structures.

    Raises:
        MachineError: the file cannot be written, or a variable is larger than the format allows.
    """
    return save_mat(_content(run, certificates=certificates), path)


def save_mat(content: Mapping[str, object], path: Path) -> list[Path]:
    """Write a document of JSON, or arrays, as variables; return the path.

    Raises:
        MachineError: the file cannot be written, or a variable is larger than the format allows.
    """
    from scipy.io import savemat  # slow to import

    buffer = io.BytesIO()
    try:
        file: Any = buffer  # SciPy's types know names of files only
        savemat(file, _fields(content), oned_as="column")
    except (ValueError, OverflowError, TypeError) as error:
        raise MachineError(f"{path}: not possible as a .mat file of version 5: {error}") from None
    header = b"MATLAB 5.0 MAT-file, written by noack".ljust(116)  # without a date
    return [write_output(path, header + buffer.getvalue()[len(header) :])]


def _content(run: ExportedRun, *, certificates: bool) -> dict[str, object]:
    record = run.record
    content: dict[str, object] = {table: _columns(record[table]) for table in record.tables}
    content["summary"] = run.summary
    content["scenario"] = record.scenario.model_dump(mode="json", exclude_none=True)
    content["environment"] = run.environment
    if record.is_network:
        content["loops"] = {loop.name: _content(loop, certificates=certificates) for loop in run.loops}
        return content
    for name, table in (("samples", samples(record)), ("events", events(record))):
        content[name] = {column: _array(table[column].to_numpy()) for column in table.column_names}
    loop = record.loop
    content["loop"] = {
        "A": loop.A,
        "B": loop.B,
        "K": loop.K,
        "A_model": loop.A_model,
        "B_model": loop.B_model,
        "state_names": list(loop.state_names),
        "input_names": list(loop.input_names),
    }
    if certificates:
        content["certificates"] = _certificates(record.scenario)
    return content


def _certificates(scenario: Scenario) -> dict[str, object]:
    """Return the certificates of a scenario, or the reason why there are none."""
    try:
        return certificates_of(scenario).to_json()
    except CallerError as error:
        return {"none": str(error)}


def _columns(rows: Rows) -> dict[str, object]:
    """Return the columns of a table: (k, 1), vectors (k, n), bytes (k, width)."""
    columns: dict[str, object] = {}
    for name in rows.dtype.names or ():
        column = rows[name]
        if column.dtype.kind == "V":
            column = np.frombuffer(column.tobytes(), np.uint8).reshape(len(rows), column.itemsize)
        columns[name] = column
    return columns


def _array(values: NDArray[np.generic]) -> NDArray[np.generic]:
    """Return a column as :func:`scipy.io.savemat` takes it; texts are a cell array."""
    return values.astype(object) if values.dtype.kind in "OU" else values


def _fields(content: Mapping[str, object]) -> dict[str, object]:
    """Return the fields of a structure, under names of MATLAB."""
    fields: dict[str, object] = {}
    for key, entry in content.items():
        fields[_unused_name(_valid_name(key), fields)] = _structure(entry)
    return fields


def _structure(value: object) -> object:
    """Return a value as :func:`scipy.io.savemat` takes it; None is an empty array."""
    if isinstance(value, Mapping):
        return _fields(value)
    if value is None:
        return np.zeros((0, 0))
    if isinstance(value, list | tuple):
        return _array_or_cells(value)
    return value


def _array_or_cells(values: Sequence[object]) -> NDArray[np.generic]:
    """Return numbers as an array; anything else as a cell array."""
    numeric = [isinstance(value, int | float) and not isinstance(value, bool) for value in values]
    if values and all(numeric):
        return np.array(values, dtype=np.float64)
    if values and all(isinstance(value, list | tuple) and value for value in values):
        rows = [_array_or_cells(value) for value in values if isinstance(value, list | tuple)]
        if all(row.dtype == np.float64 and row.shape == rows[0].shape for row in rows):
            return np.array(rows)
    cells = np.empty((len(values), 1), dtype=object)
    for i, value in enumerate(values):
        cells[i, 0] = _structure(value)
    return cells


def _valid_name(key: str) -> str:
    """Return a key as a name of MATLAB: letters, digits and _, beginning with a letter."""
    name = _INVALID_CHARACTER.sub("_", str(key))
    return (name if name[:1].isalpha() else f"f_{name}")[:_LONGEST_NAME]


def _unused_name(name: str, used_names: Mapping[str, object]) -> str:
    """Return the name, with a number if it is taken."""
    number, candidate = 1, name
    while candidate in used_names:
        number += 1
        candidate = f"{name[: _LONGEST_NAME - 4]}_{number}"
    return candidate
