"""A mistake in a command's arguments gives one line with the remedy."""

import json
import os
import shlex
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import Result

from tests.helpers.approved import compare_lines
from tests.helpers.command_line import invoke

SHIPPED = {
    "scenarios/lane_following.toml": "scenario.toml",
    "campaigns/mb_vs_zoh.toml": "campaign.toml",
    "scenarios/double_integrator.toml": "run/scenario.toml",
}
"""Copies that are given to commands that expect something else."""


def noack(line: str) -> Result:
    return invoke(*shlex.split(line))


def test_a_mistake_gives_the_approved_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(Path(__file__).parents[3])

    def mistake(line: str) -> list[str]:
        result = noack(line.replace("FOLDER", str(tmp_path)))
        assert result.exit_code in (1, 2)
        # A margin prints what is decided until it finds the mistake.
        (line,) = (line for line in result.stderr.splitlines() if not line.startswith("noack: at most "))
        return [line.replace(str(tmp_path), "FOLDER")]

    compare_lines(Path(__file__).with_name("mistakes.txt"), mistake)
    assert not [*tmp_path.iterdir()]


def test_a_wrong_kind_of_file_gives_the_approved_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The line says what the file is, or what was expected, and where it can, which command takes it."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run/record").mkdir(parents=True)
    (tmp_path / "folder").mkdir()
    for source, name in SHIPPED.items():
        shutil.copy(Path(__file__).parents[3] / source, name)
    Path("picture.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    Path("empty.toml").touch()
    Path("links.toml").write_text('[[link]]\nname = "a"\nlisten = ":0"\nto = ":9"\n')

    def mistake(line: str) -> list[str]:
        result = noack(line)
        assert result.exit_code == 2
        return [result.stderr.strip()]

    compare_lines(Path(__file__).with_name("wrong_files.txt"), mistake)


@pytest.mark.parametrize("line", ["certfy lane_following", "check nothing", "demo --set", "netem --session"])
def test_with_json_a_mistake_is_a_document_too(line: str) -> None:
    expected = noack(line).stderr
    result = noack(f"{line} --json" if line != "demo --set" else "demo --json --set")
    assert result.stderr == expected
    _, _, message = expected.strip().partition(": ")
    assert json.loads(result.stdout) == {"error": message, "exit": {"status": 2, "reason": message}}


def test_a_process_that_fails_is_named_once(tmp_path: Path) -> None:
    """Both the process's log and the launcher name the process; the message contains it once."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as endpoint:
        endpoint.bind(("127.0.0.1", 0))
        port = endpoint.getsockname()[1]
        settings = ("ports={}", f"ports.sensor={port}", "horizon_s=1")
        process = subprocess.run(
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
    assert process.returncode == 2
    assert process.stderr == f"noack: {expected} (logs in {run_dir / 'logs'})\n"
    assert (run_dir / "logs/sensor.log").read_text() == f"noack {expected}\n"
