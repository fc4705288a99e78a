"""What follows a launched run: callbacks, several of them together, and the log."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from noack.runtime.command_line import log_event
from noack.runtime.control_messages import RunProgress

if TYPE_CHECKING:
    from cosim.live.coordination.remote_access import ListenSettings

_SOURCE, _PERIOD_S = "noack", 1.0


@dataclass(frozen=True)
class Watcher:
    """Callbacks of a launched run; each must return at once."""

    waiting: Callable[[Sequence[str]], None] = lambda roles: None
    """The start barrier waits for these roles, which are started by hand."""
    listening: "Callable[[str, ListenSettings], None]" = lambda address, settings: None
    """Processes on other hosts can join at this address."""
    started: Callable[[Path], None] = lambda run_dir: None
    """The loop has started; its run directory exists."""
    progress: Callable[[RunProgress], None] = lambda progress: None
    """The recorder has sent a progress report."""
    stopping: Callable[[str], None] = lambda why: None
    """The run ends early."""
    notice: Callable[[str], None] = lambda line: None
    """A line for the person who watches the run."""


def joint_watcher(watchers: Sequence[Watcher]) -> Watcher:
    """Return a watcher that calls others in order; after an OSError, no more of that one."""
    active = list(watchers)

    def call(name: str) -> Callable[..., None]:
        def each(*arguments: object) -> None:
            for watcher in [*active]:
                try:
                    getattr(watcher, name)(*arguments)
                except OSError:  # nobody reads its output any more
                    active.remove(watcher)

        return each

    return Watcher(*(call(field.name) for field in fields(Watcher)))


def later_watcher(open_watcher: Callable[[], Watcher]) -> Watcher:
    """Return a watcher that is opened at its first callback, after the start of the processes."""
    opened = cache(open_watcher)

    def call(name: str) -> Callable[..., None]:
        return lambda *arguments: getattr(opened(), name)(*arguments)

    return Watcher(*(call(field.name) for field in fields(Watcher)))


class RunLog:
    """Logs the start of a run, and its progress once a second of wall time."""

    def __init__(self) -> None:
        self._due_s = 0.0

    def watcher(self) -> Watcher:
        """Return the callbacks of the launcher."""
        return Watcher(started=self._started, progress=self._progress)

    def _started(self, run_dir: Path) -> None:
        log_event("info", _SOURCE, f"run {run_dir} is prepared", event="run", directory=str(run_dir))

    def _progress(self, report: RunProgress) -> None:
        if time.monotonic() < self._due_s:
            return
        self._due_s = time.monotonic() + _PERIOD_S
        progress_fields = report.model_dump(exclude={"live", "warnings", "changes"})
        log_event("info", _SOURCE, f"simulated {report.t_s:.1f} s", event="progress", **progress_fields)


def log_end(status: int, reason: str, run_dir: Path) -> None:
    """Log how a run ended."""
    log_event(
        "info" if status == 0 else "error",
        _SOURCE,
        f"ended: {reason}",
        event="end",
        status=status,
        reason=reason,
        directory=str(run_dir),
    )
