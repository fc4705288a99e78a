"""A signal ends a command with one line and its status; what was recorded can be completed."""

import signal
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from cosim.cli import app
from cosim.live import finalize
from cosim.record.run_directory import SUMMARY_FILE

SHORT = ("lane_following", "--no-report", "--set", "horizon_s=1.0")
pytestmark = pytest.mark.usefixtures("usual_signals")


@pytest.mark.parametrize(
    ("number", "status", "why"),
    [
        (signal.SIGINT, 130, "stopped by the user (SIGINT)"),
        (signal.SIGTERM, 143, "stopped on request (SIGTERM)"),
        (signal.SIGHUP, 143, "stopped because the terminal was closed (SIGHUP)"),
    ],
)
def test_a_signal_while_a_run_is_finalised_names_the_command_that_completes_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals, status: int, why: str
) -> None:
    def signalled(*_: Any) -> None:
        signal.raise_signal(number)

    with monkeypatch.context() as patch:
        patch.setattr(finalize, "summarise", signalled)
        done = CliRunner().invoke(app, ["simulate", *SHORT, "--runs", str(tmp_path)])
    assert done.exit_code == status
    (run_dir,) = (path for path in tmp_path.iterdir() if not path.is_symlink())
    assert done.stderr.splitlines()[-1] == (
        f"noack: {why}; `noack summary {run_dir}` completes its record"
    )
    assert not (run_dir / SUMMARY_FILE).exists()
    assert CliRunner().invoke(app, ["summary", str(run_dir)]).exit_code == 0
    assert (run_dir / SUMMARY_FILE).is_file()


def test_a_signal_before_the_record_is_complete_leaves_no_simulated_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def signalled(*_: Any, **__: Any) -> None:
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr("cosim.live.simulated_run.write_run", signalled)
    done = CliRunner().invoke(app, ["simulate", *SHORT, "--runs", str(tmp_path)])
    assert done.exit_code == 143
    assert done.stderr.splitlines()[-1] == "noack: stopped on request (SIGTERM)"
    assert list(tmp_path.iterdir()) == []
