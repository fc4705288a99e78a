"""What an export of a run contains, for all formats."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosim.record.environment import kind_of
from cosim.record.loops_run import loop_directories
from cosim.record.run_directory import ENVIRONMENT_FILE, LOOP_FILE, SUMMARY_FILE, read_object
from cosim.record.run_record import RunRecord, load_record


@dataclass(frozen=True)
class ExportedRun:
    """A run, or one of the loops of a run of several."""

    directory: Path
    record: RunRecord
    name: str = ""
    """Of the loop; empty for the run itself."""
    phase_ns: int = 0
    """Time of the run at which the loop's own time begins."""

    @property
    def summary(self) -> dict[str, Any]:
        """The content of ``summary.json``."""
        return read_object(self.directory / SUMMARY_FILE)

    @property
    def environment(self) -> dict[str, Any]:
        """The content of ``environment.json``."""
        return read_object(self.directory / ENVIRONMENT_FILE) | {"kind": kind_of(self.directory)}

    def loops(self) -> "Iterator[ExportedRun]":
        """Yield the loops of a run of several."""
        if self.record.is_network:
            for directory in loop_directories(self.directory, self.record.scenario):
                phase_ns = read_object(directory / LOOP_FILE).get("phase_ns")
                known_ns = phase_ns if isinstance(phase_ns, int) else 0
                yield ExportedRun(directory, load_record(directory), directory.name, known_ns)


def exported_run(run_dir: Path) -> ExportedRun:
    """Return a run directory for an export.

    Raises:
        CallerError: it is not a run directory, or its record is damaged.
    """
    return ExportedRun(run_dir, load_record(run_dir, network=True))
