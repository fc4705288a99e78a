"""The run directory: the names of what it holds, and where the newest one is."""

import contextlib
import os
from datetime import datetime
from pathlib import Path

from noack.errors import CallerError, MachineError

SCENARIO_FILE = "scenario.toml"
ENVIRONMENT_FILE = "environment.json"
REPORTS_FILE = "reports.json"
RECORDING_FILE = "recording.rrd"
SUMMARY_FILE = "summary.json"
SPOOL = "spool"
RECORD = "record"
LATEST = "latest"


def new_run_dir(runs: Path, name: str) -> Path:
    """Create a fresh run directory below ``runs``.

    Raises:
        MachineError: the directory cannot be created.
    """
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    try:
        runs.mkdir(parents=True, exist_ok=True)
        for attempt in range(1000):
            run_dir = runs / (f"{stamp}-{name}" + (f"-{attempt}" if attempt else ""))
            with contextlib.suppress(FileExistsError):
                run_dir.mkdir()
                (run_dir / "logs").mkdir()
                return run_dir
    except OSError as error:
        raise MachineError(f"{runs}: no run directory can be created: {error}") from None
    raise MachineError(f"{runs}: too many runs named {stamp}-{name}")


def point_to_latest(run_dir: Path) -> None:
    """Let ``latest`` beside the run directory lead to it."""
    scratch = run_dir.parent / f".{LATEST}.{os.getpid()}"
    with contextlib.suppress(OSError):  # a convenience, not worth a run
        scratch.unlink(missing_ok=True)
        scratch.symlink_to(run_dir.name)
        scratch.replace(run_dir.parent / LATEST)


def latest_run(runs: Path) -> Path:
    """Return the newest run directory below ``runs``.

    Raises:
        CallerError: there is none.
    """
    link = runs / LATEST
    if not link.is_dir():
        raise CallerError(f"{runs}: no run yet; `noack demo` makes one")
    return link.resolve()
