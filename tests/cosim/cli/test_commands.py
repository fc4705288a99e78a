"""Behaviour that all commands share."""

import json
import signal
from pathlib import Path
from typing import Any

import pytest

from cosim.cli import options
from cosim.live import finalize
from cosim.record.run_directory import SUMMARY_FILE
from tests.helpers.command_line import invoke

INTERRUPTED = "noack: stopped by the user (SIGINT)\n"


@pytest.mark.parametrize("line", [
    "simulate lane_following", "certify lane_following", "adversary lane_following",
    "margin lane_periodic", "design lane_following --settling 14",
])  # fmt: skip
def test_ctrl_c_during_any_command_gives_one_line(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(options, "load_scenario", interrupted)
    result = invoke(*line.split())
    assert (result.exit_code, result.stdout, result.stderr) == (130, "", INTERRUPTED)
    result = invoke(*line.split(), "--json")
    assert json.loads(result.stdout)["exit"]["status"] == 130


SHORT = ("double_integrator", "--no-report", "--set", "horizon_s=0.1")


@pytest.mark.usefixtures("usual_signals", "no_report", "no_recording")
@pytest.mark.parametrize(
    ("number", "status", "reason"),
    [
        (signal.SIGINT, 130, "stopped by the user (SIGINT)"),
        (signal.SIGHUP, 143, "stopped because the terminal was closed (SIGHUP)"),
    ],
)
def test_a_signal_while_a_run_is_finalised_names_the_command_that_completes_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals, status: int, reason: str
) -> None:
    def signalled(*_: Any) -> None:
        signal.raise_signal(number)

    with monkeypatch.context() as patch:
        patch.setattr(finalize, "summarise_loop", signalled)
        result = invoke("simulate", *SHORT, "--runs", tmp_path)
    assert result.exit_code == status
    (run_dir,) = (path for path in tmp_path.iterdir() if not path.is_symlink())
    assert result.stderr.splitlines()[-1] == (
        f"noack: {reason}; the run's record is incomplete: `noack summary {run_dir}` completes it"
    )
    assert not (run_dir / SUMMARY_FILE).exists()
    assert invoke("summary", run_dir).exit_code == 0
    assert (run_dir / SUMMARY_FILE).is_file()
