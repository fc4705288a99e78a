"""What follows a live run: callbacks, and its metrics, read while it goes on."""

import json
import re
import socket
import threading
import urllib.error
from contextlib import ExitStack
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import pytest

import noack
from cosim.live.monitoring.progress import activity, work_bar
from cosim.live.monitoring.run_watcher import RunMetrics, Watcher, joint_watcher
from noack.runtime.control_messages import RunProgress
from tests.helpers.command_line import invoke
from tests.helpers.json_log import objects
from tests.helpers.metrics_readers import exposed, read, slow_reader, values_of

PROGRESS: dict[str, Any] = {
    "t_s": 2.5, "events": 7, "deliveries": 3, "longest_loss_burst": 4, "x_norm": None, "live": None,
}  # fmt: skip


def test_metrics_follow_the_launchers_reports() -> None:
    metrics = RunMetrics(noack.load("lane_following"))
    assert values_of(exposed(metrics))["noack_run_loss_burst_limit"] == 4
    watcher = metrics.watcher()
    watcher.waiting(["plant", "sensor"])
    watcher.progress(RunProgress(**PROGRESS, warnings=["void"]))
    values = values_of(exposed(metrics))
    assert values["noack_run_missing_processes"] == 2
    assert (values["noack_run_events_total"], values["noack_run_warnings_total"]) == (7, 1)
    assert "noack_run_state_norm" not in values


def test_a_watcher_whose_output_is_closed_does_not_stop_the_others() -> None:
    times_s: list[float] = []

    def closed(report: RunProgress) -> None:
        times_s.append(-1)
        raise BrokenPipeError

    joint = joint_watcher([
        Watcher(progress=closed), Watcher(progress=lambda report: times_s.append(report.t_s))
    ])  # fmt: skip
    joint.progress(RunProgress(**PROGRESS | {"t_s": 1.0}))
    joint.progress(RunProgress(**PROGRESS | {"t_s": 2.0}))
    assert times_s == [-1, 1.0, 2.0]


@pytest.mark.usefixtures("without_viewer")
def test_a_live_run_serves_its_metrics_and_logs_its_events(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = free.getsockname()
    metrics: dict[str, float] = {}
    done = threading.Event()

    def scrape() -> None:
        while not done.is_set():
            try:
                values = values_of(read(address))
            except (urllib.error.URLError, ConnectionError):
                done.wait(0.02)
                continue
            if not metrics:
                stack.enter_context(slow_reader(address))
            metrics.update(values)
            done.wait(0.1)

    reader = threading.Thread(target=scrape)
    stack = ExitStack()
    reader.start()
    words = ["run", "lane_following", "--set", "horizon_s=1", "--set", "ports={}", "--json"]
    more = ["--no-report", "--runs", str(tmp_path), "--metrics", f":{address[1]}"]
    more += ["--log-format", "jsonl"]
    try:
        finished = invoke(*words, *more)
    finally:
        done.set()
        reader.join()
        stack.close()
    assert finished.exit_code == 0, finished.stderr
    summary = json.loads(finished.stdout)
    assert 0 < metrics["noack_run_simulated_seconds"] <= summary["reached_s"]
    assert metrics["noack_run_events_total"] <= summary["loops"][0]["events"]
    assert metrics["noack_run_state_norm"] > 0
    events = {line["event"]: line for line in objects(finished.stderr) if "event" in line}
    (run_dir,) = (path for path in tmp_path.iterdir() if not path.is_symlink())
    assert events["run"]["directory"] == events["end"]["directory"] == str(run_dir)
    assert (events["end"]["status"], events["end"]["reason"]) == (0, "horizon")
    assert events["progress"]["events"] <= summary["loops"][0]["events"]


def test_long_work_prints_its_share_and_the_remaining_time_as_lines_without_a_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now_s = [100.0]
    monkeypatch.setattr("cosim.live.monitoring.progress.time.monotonic", lambda: now_s[0])
    for lines in (True, False):
        with work_bar("trying gains", lines=lines) as show:
            for share in (0.1, 0.2, 0.25, 1.0):
                now_s[0] += 6
                show(share)
        text = capsys.readouterr().err
        assert text == lines * "noack: trying gains: 20 % after 12 s, about 48 s left\n"


def test_what_a_command_does_is_printed_as_lines_without_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    lines: SimpleQueue[str] = SimpleQueue()
    monkeypatch.setattr("cosim.live.monitoring.progress._LINE_EVERY_S", 0.001)
    monkeypatch.setattr("cosim.live.monitoring.progress.print_to_stderr", lines.put)
    with activity("examining M = 1") as change:
        assert re.fullmatch(r"noack: examining M = 1, \d+ s", lines.get(timeout=60))
        change("examining M = 2")
        while not lines.get(timeout=60).startswith("noack: examining M = 2, "):
            pass
