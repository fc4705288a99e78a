"""The outcome of a run, for tables and programs."""

from dataclasses import dataclass
from pathlib import Path

from cosim.analysis.run_summary import Summary
from noack.core.errors import ExitStatus


@dataclass(frozen=True)
class Outcome:
    """The outcome of a run."""

    run_dir: Path
    status: ExitStatus
    reason: str
    summary: Summary
