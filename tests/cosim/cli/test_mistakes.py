"""A mistake in a command's arguments gives one line with the remedy."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from cosim.cli import app

MISTAKES = {
    "certfy lane_following": "noack: no such command 'certfy'. Did you mean 'certify'?",
    "--verson": "noack: no such option: --verson; did you mean --version?",
    "--nothing-like-it": "noack: no such option: --nothing-like-it; see `noack --help`",
    "certify": "noack: certify: missing argument 'scenario', e.g. `noack certify lane_following`",
    "design lane_following": "noack: design: missing option '--settling', "
    "e.g. `noack design lane_following --settling 14`",
    "certify lane_following --wieght chosen": "noack: certify: no such option: --wieght; "
    "did you mean --weight?",
    "certify lane_following --late soon": "noack: certify: invalid value for '--late': should be "
    "a valid integer, unable to parse string as an integer; see `noack certify --help`",
    "certify lane_following --late 2000": "noack: certify: invalid value for '--late': should be "
    "less than or equal to 1000; see `noack certify --help`",
    "adversary lane_following --trigger no": "noack: adversary: invalid value for '--trigger': "
    "'no' is not one of 'sampled', 'continuous'; see `noack adversary --help`",
    "check lane_following too": "noack: check: got unexpected extra argument(s) (too); "
    "see `noack check --help`",
    "demo --set": "noack: demo: option '--set' requires an argument; see `noack demo --help`",
    "record lane_following --invite plant": "noack: --invite needs --listen: processes of this "
    "host need no invitation",
    "netem --lisen :9000": "noack netem: unrecognized arguments: --lisen; see `noack netem --help`",
    "netem --seed many --listen :9000 --to :9001": "noack netem: --seed: invalid int value: "
    "'many'; see `noack netem --help`",
    "netem --session": "noack netem: --session: expected one argument; see `noack netem --help`",
    "netem show --name dns": "noack netem show: unrecognized arguments: --name; "
    "see `noack netem show --help`",
    "netem watch a b": "noack netem watch: unrecognized arguments: b; "
    "see `noack netem watch --help`",
}
_LIST = "`noack scenarios` lists the shipped ones"
NOT_FOUND = {
    "lane_folowing": "lane_folowing: no such file, nor a shipped scenario; did you mean "
    "lane_following?",
    "nothing": f"nothing: no such file, nor a shipped scenario; {_LIST}",
    "nope.toml": f"nope.toml: no such file, nor a shipped scenario; {_LIST}",
    "quadrotor_hove.toml": "quadrotor_hove.toml: no such file, nor a shipped scenario; did you "
    "mean quadrotor_hover?",
    "q" * 3000: f"{'q' * 77}...: no such file, nor a shipped scenario; {_LIST}",
    "mb_vs_zoh": "mb_vs_zoh: a shipped campaign, not a scenario",
}


def noack(line: str) -> Result:
    return CliRunner().invoke(app, line.split(), prog_name="noack")


@pytest.mark.parametrize(("line", "expected"), MISTAKES.items())
def test_a_mistake_gives_one_line_and_with_json_a_document(line: str, expected: str) -> None:
    done = noack(line)
    assert (done.exit_code, done.stdout, done.stderr) == (2, "", f"{expected}\n")
    done = noack(f"{line} --json" if line != "demo --set" else "demo --json --set")
    document = json.loads(done.stdout)
    _, _, message = expected.partition(": ")
    assert document == {"error": message, "exit": {"status": 2, "reason": message}}
    assert done.stderr == f"{expected}\n"


@pytest.mark.parametrize(("name", "expected"), NOT_FOUND.items())
def test_an_unknown_scenario_suggests_the_nearest_name(name: str, expected: str) -> None:
    done = noack(f"check {name} --json")
    assert (done.exit_code, done.stderr) == (2, f"noack: {expected}\n")
    assert json.loads(done.stdout)["error"] == expected


@pytest.mark.parametrize("command", ["certify", "simulate", "run", "doctor"])
def test_every_command_reports_an_unknown_scenario(command: str) -> None:
    assert noack(f"{command} nothing").stderr == noack("check nothing").stderr


def test_a_long_key_is_shortened() -> None:
    done = noack(f"check lane_following --set trigger.{'k' * 3000}=1")
    assert done.exit_code == 2
    assert done.stderr.startswith(f"noack: --set trigger.{'k' * 69}... = 1: unknown key; ")
    assert len(done.stderr) < 400


def test_the_help_is_shown_without_a_command() -> None:
    done = noack("")
    assert done.exit_code == 2
    assert "noack doctor" in done.stdout
    assert done.stderr == ""


def test_a_process_that_fails_is_named_once(tmp_path: Path) -> None:
    """Both the process's log and the launcher name the process; the message contains it once."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        settings = ("ports={}", f"ports.sensor={port}", "horizon_s=1")
        done = subprocess.run(
            [sys.executable, "-m", "cosim.cli", "run", "double_integrator",
             "--runs", tmp_path / "runs",
             *(word for setting in settings for word in ("--set", setting))],
            capture_output=True, text=True, check=False,
            env=os.environ | {"XDG_RUNTIME_DIR": str(tmp_path)},  # other runs would be warned of
        )  # fmt: skip
    (run_dir,) = (tmp_path / "runs").iterdir()
    expected = (
        f"sensor: UDP port 127.0.0.1:{port} is already taken by another program; "
        "set ports.sensor to another port, or to 0 for any"
    )
    assert done.returncode == 2
    assert done.stderr == f"noack: {expected} (logs in {run_dir / 'logs'})\n"
    assert (run_dir / "logs/sensor.log").read_text() == f"noack {expected}\n"


def test_a_folder_that_cannot_be_written_is_named_once() -> None:
    done = noack("simulate double_integrator --runs /dev/null/runs")
    assert (
        done.stderr == "noack: /dev/null/runs: no run directory can be created: Not a directory\n"
    )


def test_a_deleted_current_folder_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    monkeypatch.chdir(folder)
    folder.rmdir()
    done = CliRunner().invoke(app, ["simulate", "lane_following"])
    assert (done.exit_code, done.stderr) == (1, "noack: the current folder was deleted\n")
