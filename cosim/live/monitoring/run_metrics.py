"""A live run as metrics of OpenMetrics; the names begin with ``noack_run_``.

They are computed in the launcher's process, from what the launcher knows anyway: the loop itself is
not asked.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from prometheus_client import Metric
from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily

from cosim.live.monitoring.run_watcher import Watcher
from noack.runtime.control_messages import RunProgress
from noack.scenario.scenario import Scenario

_PREFIX = "noack_run"
_GAUGES = {
    "simulated_seconds": ("t_s", "simulated time of the newest measurement"),
    "longest_loss_burst": ("longest_loss_burst", "most consecutive losses so far"),
    "state_norm": ("x_norm", "norm of the newest measured state; of several loops the largest"),
}
_COUNTERS = {
    "events": "updates sent by the sensor",
    "deliveries": "updates received by the controller",
    "warnings": "void claims and diverging loops",
    "changes": "changes of settings during the run",
}


class RunMetrics:
    """What the launcher knows of a run, as metrics."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._directory = ""
        self._report: RunProgress | None = None
        self._waiting = 0
        self._failures: Counter[str] = Counter()
        self._restarts: Counter[str] = Counter()

    def watcher(self) -> Watcher:
        """Return the callbacks of the launcher."""
        return Watcher(
            waiting=self._wait,
            started=self._start,
            failed=self._fail,
            restarted=self._restart,
            progress=self._progress,
        )

    def _wait(self, roles: Sequence[str]) -> None:
        self._waiting = len(roles)

    def _start(self, run_dir: Path) -> None:
        self._directory = str(run_dir)

    def _fail(self, why: str, t_s: float, by_hand: str | None) -> None:
        self._failures["process"] += 1

    def _restart(self, role: str, t_s: float) -> None:
        self._restarts[role] += 1

    def _progress(self, report: RunProgress) -> None:
        self._report = report

    def collect(self) -> Iterator[Metric]:
        """Yield the metrics; those of the loop from its first report on."""
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
        restarts = CounterMetricFamily(f"{_PREFIX}_restarts", "restarted processes", labels=["process"])
        for role, count in self._restarts.items():
            restarts.add_metric([role], count)
        yield restarts
        yield CounterMetricFamily(f"{_PREFIX}_failures", "processes that failed", self._failures.total())
        if (report := self._report) is not None:
            yield from _of_loop(report)


def _of_loop(report: RunProgress) -> Iterator[Metric]:
    for name, (key, text) in _GAUGES.items():
        if (value := getattr(report, key)) is not None:
            yield GaugeMetricFamily(f"{_PREFIX}_{name}", text, value)
    for key, text in _COUNTERS.items():
        value = getattr(report, key)
        count = len(value) if isinstance(value, list) else value
        yield CounterMetricFamily(f"{_PREFIX}_{key}", text, count)
