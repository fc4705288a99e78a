"""Who follows a live run: observers, also of extensions, its log, and progress."""

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from cosim.live.monitoring import run_observers
from cosim.live.monitoring.run_observers import RunObserver, RunObservers
from noack.runtime.control_messages import RunProgress
from tests.helpers.command_line import invoke
from tests.helpers.json_log import objects
from tests.helpers.shipped import resolved

PROGRESS: dict[str, Any] = {
    "t_s": 2.5, "events": 7, "deliveries": 3, "longest_loss_burst": 4, "x_norm": None, "live": None,
}  # fmt: skip


class Follower(RunObserver):
    """Notes the times of progress reports, and then raises an error, if it has one."""

    def __init__(self, error: Exception | None = None) -> None:
        self.times_s: list[float] = []
        self._error = error

    def progress(self, report: RunProgress) -> None:
        self.times_s.append(report.t_s)
        if self._error is not None:
            raise self._error


def test_an_observer_that_fails_is_told_no_more_and_does_not_stop_the_others(
    capsys: pytest.CaptureFixture[str],
) -> None:
    closed, wrong, well = Follower(BrokenPipeError()), Follower(ValueError("no\nnumber")), Follower()
    observers = RunObservers([closed, wrong, well])
    for t_s in (1.0, 2.0):
        report = RunProgress(**PROGRESS | {"t_s": t_s})
        observers.tell(lambda observer, report=report: observer.progress(report))
    assert (closed.times_s, wrong.times_s, well.times_s) == ([1.0], [1.0], [1.0, 2.0])
    # Of a closed output nobody reads a warning.
    assert capsys.readouterr().err == "noack: warning: Follower no longer follows the run: no number\n"


def test_an_installed_extension_follows_each_run(monkeypatch: pytest.MonkeyPatch) -> None:
    own = Follower()
    extension = SimpleNamespace(observer=lambda scenario: own)

    def modules(package: object, group: str, read: Callable[[Any], Any]) -> list[Any]:
        assert (package, group) == (None, "noack.observers_of_runs")
        assert read(SimpleNamespace()) is None
        return [read(extension)]

    monkeypatch.setattr(run_observers, "parts", modules)
    assert run_observers.observers_of_extensions(resolved("lane_following")) == [own]


@pytest.mark.usefixtures("without_viewer")
def test_a_live_run_logs_its_events(tmp_path: Path) -> None:
    words = ["run", "lane_following", "--set", "horizon_s=1", "--set", "ports={}", "--json"]
    finished = invoke(*words, "--no-report", "--runs", str(tmp_path), "--log-format", "jsonl")
    assert finished.exit_code == 0, finished.stderr
    summary = json.loads(finished.stdout)
    events = {line["event"]: line for line in objects(finished.stderr) if "event" in line}
    (run_dir,) = (path for path in tmp_path.iterdir() if not path.is_symlink())
    assert events["run"]["directory"] == events["end"]["directory"] == str(run_dir)
    assert (events["end"]["status"], events["end"]["reason"]) == (0, "horizon")
    assert events["progress"]["events"] <= summary["loops"][0]["events"]
