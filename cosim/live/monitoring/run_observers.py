"""Who follows a launched run: what an observer is told, those of extensions, and the log."""

import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from types import ModuleType

from cosim.live.coordination.remote_access import ListenSettings
from netem.core.command_line import log_event, print_to_stderr
from netem.core.errors import one_line
from netem.core.extension_points import parts
from noack.runtime.control_messages import RunProgress
from noack.scenario.scenario import Scenario

_SOURCE, _PERIOD_S = "noack", 1.0


class RunObserver:
    """Follows a live run. A subclass overrides what it wants to be told; each method must return at once.

    An observer that raises an exception is told no more, and the run goes on. Give it to
    :func:`noack.run` by ``observers``.

    >>> import noack
    >>> class Printer(noack.RunObserver):
    ...     def started(self, run_dir):
    ...         print("the loop runs;", run_dir)
    >>> Printer().started("runs/one")
    the loop runs; runs/one
    """

    def waiting(self, roles: Sequence[str]) -> None:
        """The start barrier waits for these roles, which are started by hand."""

    def listening(self, settings: ListenSettings) -> None:
        """Processes on other hosts can join."""

    def started(self, run_dir: Path) -> None:
        """The loop has started; its run directory exists."""

    def progress(self, report: RunProgress) -> None:
        """The recorder has sent a progress report."""

    def stopping(self, why: str) -> None:
        """The run ends early."""

    def notice(self, line: str) -> None:
        """There is a line for the person who watches the run."""


class RunObservers:
    """The observers of a run, which are told in order."""

    def __init__(self, observers: Iterable[RunObserver]) -> None:
        self._observers = list(observers)

    def tell(self, message: Callable[[RunObserver], None]) -> None:
        """Call a method of each observer; drop those that raise an exception."""
        for observer in [*self._observers]:
            try:
                message(observer)
            except OSError:  # nobody reads its output any more
                self._observers.remove(observer)
            except Exception as error:  # the run is worth more than who follows it
                self._observers.remove(observer)
                name = type(observer).__name__
                print_to_stderr(f"noack: warning: {name} no longer follows the run: {one_line(error)}")


def observers_of_extensions(scenario: Scenario) -> list[RunObserver]:
    """Return an observer of each extension that has one.

    A module of the group ``noack.observers_of_runs`` has a function ``observer(scenario)``, which
    returns it.
    """

    def read(module: ModuleType) -> RunObserver | None:
        observer = module.observer(scenario) if hasattr(module, "observer") else None
        return observer if isinstance(observer, RunObserver) else None

    return list(parts(None, "noack.observers_of_runs", read))


class RunLog(RunObserver):
    """Logs the start of a run, and its progress once a second of wall time."""

    def __init__(self) -> None:
        self._due_s = 0.0

    def started(self, run_dir: Path) -> None:
        """Log the run directory."""
        log_event("info", _SOURCE, f"run {run_dir} is prepared", event="run", directory=str(run_dir))

    def progress(self, report: RunProgress) -> None:
        """Log the progress report, if it is due."""
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
