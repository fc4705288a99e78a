"""The events of a live run for a log of JSON Lines; text is logged without it, too."""

import time
from pathlib import Path
from typing import Any

from cosim.live.launcher import Watcher
from noack.runtime.command_line import log_event

_SOURCE = "noack"
_EVERY_S = 1.0


class RunLog:
    """Logs the start of a run, and its progress once a second of wall time."""

    def __init__(self) -> None:
        self._due_s = 0.0

    def watcher(self) -> Watcher:
        """Return the callbacks of the launcher."""
        return Watcher(started=self._started, progress=self._progress)

    def _started(self, run_dir: Path) -> None:
        log_event(
            "info", _SOURCE, f"run {run_dir} is prepared", event="run", directory=str(run_dir)
        )

    def _progress(self, report: dict[str, Any]) -> None:
        if time.monotonic() < self._due_s:
            return
        self._due_s = time.monotonic() + _EVERY_S
        names = ("t_s", "events", "deliveries", "longest_loss_burst", "x_norm")
        message = f"simulated {report['t_s']:.1f} s"
        fields = {name: report[name] for name in names}
        log_event("info", _SOURCE, message, event="progress", **fields)


def log_end(status: int, reason: str, run_dir: Path) -> None:
    """Log how a run ended."""
    log_event(
        "info" if status == 0 else "error", _SOURCE, f"ended: {reason}",
        event="end", status=status, reason=reason, directory=str(run_dir),
    )  # fmt: skip
