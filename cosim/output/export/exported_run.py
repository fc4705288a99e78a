"""What an export of a run contains, for all formats."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosim.analysis.summary_model import read_summary
from cosim.record.environment import kind_of
from cosim.record.run_directory import ENVIRONMENT_FILE, SUMMARY_FILE, read_object
from cosim.record.run_record import RunRecord, load_run
from noack.config.scenario import phases_ns


@dataclass(frozen=True)
class ExportedRun:
    """A run, or one of the loops of a run."""

    directory: Path
    record: RunRecord
    """Of the only loop, or of the network that the loops share."""
    summary: dict[str, Any]
    """The content of ``summary.json``, or its part about the loop."""
    inner: "Sequence[ExportedRun]" = ()
    """The loops that share the network."""
    name: str = ""
    """Of the loop; empty for the run itself."""
    phase_ns: int = 0
    """Time of the run at which the loop's own time begins."""

    @property
    def environment(self) -> dict[str, Any]:
        """The content of ``environment.json``."""
        return read_object(self.directory / ENVIRONMENT_FILE) | {"kind": kind_of(self.directory)}


def exported_run(run_dir: Path, loop: str | None = None) -> ExportedRun:
    """Return a run directory, or one of its loops, for an export.

    Raises:
        CallerError: it is not a run directory, its record is damaged, or there is no such loop.
    """
    run, content = load_run(run_dir), read_object(run_dir / SUMMARY_FILE)
    if loop is not None or len(run.loops) == 1:
        record = run.loop(loop)
        summary = read_summary(content)
        own = summary.of_loop(record.scenario.name).to_json() if summary else content
        return ExportedRun(run_dir, record, own)
    parts = dict(zip(run.names, content.get("loops", []), strict=False))
    inner = [
        ExportedRun(run_dir, record, parts.get(name, {}), (), name, phase_ns)
        for name, record, phase_ns in zip(
            run.names, run.loops, phases_ns(run.scenario), strict=True
        )
    ]
    return ExportedRun(run_dir, run.network, content, inner)
