"""What follows a launched run: callbacks, several of them together, the log, and the metrics."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from noack.runtime.command_line import log_event
from noack.runtime.control_messages import RunProgress

if TYPE_CHECKING:
    from prometheus_client import Metric

    from cosim.live.coordination.remote_access import ListenSettings
    from noack.scenario.scenario import Scenario

_SOURCE, _PERIOD_S = "noack", 1.0
_PREFIX = "noack_run"
_GAUGES = {
    "simulated_seconds": ("t_s", "simulated time of the newest measurement"),
    "longest_loss_burst": ("longest_loss_burst", "most consecutive losses so far"),
    "state_norm": ("x_norm", "norm of the newest measured state; of several loops the largest"),
}
_COUNTERS = {
    "events": "updates sent by the sensor",
    "deliveries": "updates received by the controller",
    "warnings": "what cannot be shown during the run",
    "changes": "changes of settings during the run",
}


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


class RunMetrics:
    """What the launcher knows of a run, as metrics of OpenMetrics; the loop itself is not asked.

    The names begin with ``noack_run_``.
    """

    def __init__(self, scenario: "Scenario") -> None:
        self._scenario = scenario
        self._directory = ""
        self._report: RunProgress | None = None
        self._waiting = 0

    def watcher(self) -> Watcher:
        """Return the callbacks of the launcher."""
        return Watcher(
            waiting=self._wait,
            started=self._start,
            progress=self._progress,
        )

    def _wait(self, roles: Sequence[str]) -> None:
        self._waiting = len(roles)

    def _start(self, run_dir: Path) -> None:
        self._directory = str(run_dir)

    def _progress(self, report: RunProgress) -> None:
        self._report = report

    def collect(self) -> "Iterator[Metric]":
        """Yield the metrics; those of the loop from its first report on."""
        from prometheus_client.metrics_core import (  # an extra
            CounterMetricFamily,
            GaugeMetricFamily,
            InfoMetricFamily,
        )

        scenario = self._scenario
        about = {"scenario": scenario.name, "directory": self._directory}
        yield InfoMetricFamily(_PREFIX, "the run", value=about)
        for name, text, value in (
            ("horizon_seconds", "simulated time at which the run ends", scenario.horizon_s),
            ("speed", "simulated time per wall time", scenario.speed),
            ("loss_burst_limit", "most consecutive losses allowed (M - 1)", scenario.network.mansd),
            ("missing_processes", "processes that the start barrier waits for", self._waiting),
        ):
            yield GaugeMetricFamily(f"{_PREFIX}_{name}", text, value)
        if (report := self._report) is None:
            return
        for name, (key, text) in _GAUGES.items():
            if (value := getattr(report, key)) is not None:
                yield GaugeMetricFamily(f"{_PREFIX}_{name}", text, value)
        for key, text in _COUNTERS.items():
            value = getattr(report, key)
            count = len(value) if isinstance(value, list) else value
            yield CounterMetricFamily(f"{_PREFIX}_{key}", text, count)
