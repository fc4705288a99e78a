"""Tables of results as files."""

from collections.abc import Iterable
from pathlib import Path

from cosim.record.run_directory import require_folder, write_output
from netem.output.result_tables import ResultTable, as_csv


def save_tables(tables: Iterable[ResultTable], folder: Path) -> list[Path]:
    """Write tables into a folder, each as ``NAME.csv``.

    Returns:
        The written files.

    Raises:
        MachineError: a file cannot be written.
    """
    require_folder(folder)
    return [write_output(folder / f"{table.name}.csv", as_csv(table)) for table in tables]
