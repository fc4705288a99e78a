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
    "adversary lane_following --trigger no": "noack: adversary: invalid value for '--trigger': "
    "'no' is not one of 'sampled', 'continuous'; see `noack adversary --help`",
    "check lane_following too": "noack: check: got unexpected extra argument(s) (too); "
    "see `noack check --help`",
    "report --tables=": "noack: report: the value of --tables is empty; see `noack report --help`",
    "campaign scenarios/lane_following.toml": "noack: scenarios/lane_following.toml: a scenario, "
    "not a campaign; a campaign names one by scenario = FILE",
    "demo --set": "noack: demo: option '--set' requires an argument; see `noack demo --help`",
    "record lane_following --invite plant": "noack: --invite needs --listen: processes of this "
    "host need no invitation",
    "netem --lisen :9000": "noack netem: unrecognized arguments: --lisen; see `noack netem --help`",
    "netem --seed many --listen :9000 --to :9001": "noack netem: --seed: invalid int value: "
    "'many'; see `noack netem --help`",
    "netem --session": "noack netem: --session: expected one argument; see `noack netem --help`",
    "netem watch a b": "noack netem watch: unrecognized arguments: b; "
    "see `noack netem watch --help`",
}
_LIST = "`noack scenarios` lists the shipped ones"
NOT_FOUND = {
    "nothing": f"nothing: no such file, nor a shipped scenario; {_LIST}",
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


def test_every_command_names_what_it_does_not_find(tmp_path: Path) -> None:
    for command in ("run", "doctor", "simulate"):
        assert noack(f"{command} nothing").stderr == noack("check nothing").stderr
    for line, expected in (
        ("scenarios lane_folowing", "lane_folowing: not a shipped file; did you mean lane_fol"),
        ("campaign mb_vs_zho", "mb_vs_zho: no such file, nor a shipped campaign; did you mean"),
        (f"report {tmp_path}", f"{tmp_path}: not a run directory (no scenario.toml)"),
        ("simulate double_integrator --runs /dev/null/runs", "/dev/null/runs: no run directory"),
    ):
        done = noack(line)
        assert done.exit_code in (1, 2)
        assert done.stderr.startswith(f"noack: {expected}")
        assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(("name", "expected"), NOT_FOUND.items())
def test_an_unknown_scenario_suggests_the_nearest_name(name: str, expected: str) -> None:
    done = noack(f"check {name} --json")
    assert (done.exit_code, done.stderr) == (2, f"noack: {expected}\n")
    assert json.loads(done.stdout)["error"] == expected


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


def test_a_deleted_current_folder_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder := tmp_path / "folder").mkdir()
    monkeypatch.chdir(folder)
    folder.rmdir()
    done = noack("simulate lane_following")
    assert (done.exit_code, done.stderr) == (1, "noack: the current folder was deleted\n")
