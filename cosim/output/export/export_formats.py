"""The formats of an export, by the ending of the file; a path without an ending is a folder."""

from enum import StrEnum
from pathlib import Path

from noack.core.errors import CallerError


class ExportFormat(StrEnum):
    """Formats of an export."""

    MAT = "mat"
    MCAP = "mcap"
    CSV = "csv"

    @property
    def suffix(self) -> str:
        """Ending of the path; a folder has none."""
        return "" if self is ExportFormat.CSV else f".{self}"


def export_run(
    run_dir: Path,
    path: Path,
    kind: ExportFormat | None = None,
    *,
    loop: str | None = None,
    certificates: bool = True,
) -> list[Path]:
    """Export a run; return the written files.

    Args:
        run_dir: the run directory, which has a summary.
        path: the file, or for CSV the folder.
        kind: the format; by default that of the path's ending.
        loop: name of the loop to export; by default the whole run.
        certificates: whether a file of MATLAB has the certificates of each loop.

    Raises:
        CallerError: the ending is not that of a format, it is not a run directory, or the record is
            damaged.
        MachineError: a file cannot be written.
    """
    from cosim.output.export.exported_run import exported_run

    kinds = {one.suffix: one for one in ExportFormat}
    found = kinds.get(path.suffix) if kind is None else kind
    if found is None or found.suffix not in ("", path.suffix):
        expected = "a folder, .mat or .mcap" if kind is None else found and found.suffix
        raise CallerError(f"{path}: an export is written to {expected}")
    run = exported_run(run_dir, loop)
    if found is ExportFormat.MAT:
        from cosim.output.export.mat_export import write_mat

        return write_mat(run, path, certificates=certificates)
    if found is ExportFormat.MCAP:
        from cosim.output.export.mcap_export import write_mcap

        return write_mcap(run, path)
    from cosim.output.export.csv_export import write_csv

    return write_csv(run, path)
