"""Whether a run's record fits on the disk."""

import shutil
import sys
from pathlib import Path

from cosim.record.run_directory import LEAST_FREE_BYTES
from netem.core.errors import MachineError
from netem.core.number_format import byte_size

_COPIES_AT_END = 3
"""At the end of a run, spool, record and view exist together, each of about the same size."""


def needed_bytes(step_bytes: int) -> int:
    """Bytes on the disk until the end of a run that records ``step_bytes``."""
    return _COPIES_AT_END * step_bytes


def require_disk_space(step_bytes: int, runs: Path) -> None:
    """Check that a run's record fits on the disk; warn if it may not.

    Args:
        step_bytes: what the run records, see :class:`noack.scenario.resolution.ResolvedRun`.
        runs: where run directories are made.

    Raises:
        MachineError: the record needs more than the free space.
    """
    folder = next((path for path in (runs, *runs.absolute().parents) if path.is_dir()), None)
    if folder is None:
        return
    free, needed = shutil.disk_usage(folder).free, needed_bytes(step_bytes)
    if free >= needed or free < LEAST_FREE_BYTES:  # then no run can begin at all
        return
    text = (
        f"{runs}: this run records {byte_size(step_bytes)} and needs {byte_size(needed)} until its end; "
        f"{byte_size(free)} are free on the disk"
    )
    if free < step_bytes:
        raise MachineError(f"{text}; reduce horizon_s, or choose another disk with --runs")
    print(f"noack: warning: {text}", file=sys.stderr)
