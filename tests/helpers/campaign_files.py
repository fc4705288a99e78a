"""The files of a campaign's folder."""

from pathlib import Path


def files(folder: Path) -> dict[str, int]:
    """Parquet files and their modification times."""
    return {str(path.relative_to(folder)): path.stat().st_mtime_ns for path in folder.rglob("*.parquet")}
