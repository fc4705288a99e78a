"""Behaviour that all commands share."""

import json
import signal
import tomllib
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from cosim.cli import options
from cosim.live import finalize
from cosim.record.run_directory import SUMMARY_FILE
from tests.helpers.command_line import invoke


def test_check_prints_the_defaults_that_depend_on_other_keys(tmp_path: Path, content: dict[str, Any]) -> None:
    path = tmp_path / "small.toml"

    def message() -> str:
        path.write_text(tomli_w.dumps(content))
        result = invoke("check", path)
        assert result.exit_code == 0, result.stderr
        assert result.stderr == ""
        assert tomllib.loads(result.stdout)["name"] == content["name"]
        return " ".join(result.stdout.replace("\n# ", "\n").split())

    silent = message()
    assert "watchdog: policy hold" in silent
    content["plant"]["watchdog"] = {"timeout_s": 0.2}
    assert "timeout_input: no effect" not in silent
    content["controller"] = {"safe_input": [0.1], "timeout_input": "hold"}
    content["start_within_s"] = 60.0
    content["trigger"] = {"policy": "periodic", "period_s": 0.0031}
    explicit = message()
    assert "trigger.period_s: updates are sent at measurements, every 0.004 s" in explicit
    assert "timeout_input: no effect without controller.update_timeout_s" in explicit
    assert not any(key in explicit for key in ("watchdog:", "safe_input:", "_within_s:"))


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
