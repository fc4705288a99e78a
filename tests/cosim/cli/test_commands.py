"""Behaviour that all commands share."""

import json
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
import tomli_w
from typer.testing import CliRunner

from cosim.cli import app
from cosim.cli import command as cli
from cosim.shipped_files import find_shipped


@pytest.mark.skipif(sys.platform == "win32", reason="a POSIX shell's redirection")
def test_a_command_without_standard_output_ends_normally() -> None:
    command = f"'{sys.executable}' -m cosim.cli schema --json >&-"
    done = subprocess.run(["sh", "-c", command], check=False, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("keys", [
    {"policy": "lyapunov", "rate_per_s": 1.0},
    {"policy": "dynamic", "sigma": 0.5, "theta_s": 0.5, "decay_per_s": 0.5},
])  # fmt: skip
def test_check_refuses_a_policy_that_needs_a_stable_loop_if_it_is_unstable(
    tmp_path: Path, content: dict[str, Any], keys: dict[str, Any]
) -> None:
    content["trigger"] = keys
    content["model"] |= {"gain": [[3.0, 3.0]], "allow_unstable": True}
    path = tmp_path / "unstable.toml"
    path.write_text(tomli_w.dumps(content))
    result = CliRunner().invoke(app, ["check", str(path)])
    assert result.exit_code == 2
    assert result.stderr.endswith("but Â + B̂K is not stable\n")
    assert result.stdout == ""


def test_check_prints_the_defaults_that_depend_on_other_keys(
    tmp_path: Path, content: dict[str, Any]
) -> None:
    path = tmp_path / "small.toml"

    def message() -> str:
        path.write_text(tomli_w.dumps(content))
        done = CliRunner().invoke(app, ["check", str(path)])
        assert done.exit_code == 0, done.stderr
        assert done.stderr == ""
        assert tomllib.loads(done.stdout)["name"] == content["name"]
        return " ".join(done.stdout.replace("\n# ", "\n").split())

    silent = message()
    assert "plant.watchdog: policy hold, after 0.1 s without an actuation" in silent
    assert "controller.safe_input: 0, the input before the first update" in silent
    assert "recovery.rejoin_within_s: 0, a process that dies ends the run;" in silent
    assert "start_within_s: 30, longer on a busy machine" in silent
    content["plant"]["watchdog"] = {"timeout_s": 0.2}
    content["controller"] = {"safe_input": [0.1]}
    content["recovery"] = {"rejoin_within_s": 5.0}
    content["start_within_s"] = 60.0
    explicit = message()
    assert not any(key in explicit for key in ("watchdog:", "safe_input:", "_within_s:"))


INTERRUPTED = "noack: stopped by the user (SIGINT)\n"


def test_ctrl_c_during_a_simulation_gives_one_line_and_leaves_no_run(tmp_path: Path) -> None:
    """The trigger's class sends the signal, amid the run."""
    (tmp_path / "own.py").write_text(
        "import signal\n"
        "class Own:\n"
        "    def start(self, t_s, x): pass\n"
        "    def test(self, t_s, x, e_s):\n"
        "        if t_s > 0.5: signal.raise_signal(signal.SIGINT)\n"
        "        return False\n"
    )
    trigger = 'trigger={policy="python", file="own.py", name="Own"}'
    shutil.copy(find_shipped("double_integrator", "scenarios"), tmp_path / "own.toml")
    done = subprocess.run(
        [sys.executable, "-m", "cosim.cli", "simulate", "own.toml", "--set", trigger],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (130, "", INTERRUPTED)
    assert list((tmp_path / "runs").iterdir()) == []


@pytest.mark.parametrize("line", [
    "simulate lane_following", "certify lane_following", "adversary lane_following",
    "margin lane_periodic", "design lane_following --settling 14",
])  # fmt: skip
def test_ctrl_c_during_any_command_gives_one_line(
    line: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "load_scenario", interrupted)
    done = CliRunner().invoke(app, line.split(), prog_name="noack")
    assert (done.exit_code, done.stdout, done.stderr) == (130, "", INTERRUPTED)
    done = CliRunner().invoke(app, [*line.split(), "--json"], prog_name="noack")
    assert json.loads(done.stdout)["exit"]["status"] == 130
