"""Completion, called as by a shell."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cosim.cli import app
from noack.scenario.scenario import Scenario
from noack.scenario.toml_file import keys


def completed(line: str) -> list[str]:
    """The completions that bash offers for the last word of a line."""
    place = str(len(line.split(" ")) - 1)
    asked = {"_NOACK_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": place}
    done = CliRunner().invoke(app, env=asked, prog_name="noack")
    assert done.stderr == ""
    return done.stdout.split()


@pytest.mark.parametrize(("line", "offered"), [
    ("noack ca", ["campaign", "capacity"]),
    ("noack rep", ["replay", "report", "reproduce"]),
    ("noack certify lane_f", ["lane_following"]),
    ("noack doctor quad", ["quadrotor_hover"]),
    ("noack campaign mb", ["mb_vs_zoh"]),
    ("noack run lane_following --set trigger.be", ["trigger.beta="]),
    ("noack run lane_following --set network.mansd", ["network.mansd="]),
    ("noack view runs/l", ["runs/latest"]),
    ("noack replay runs/2", ["runs/20260102-000000-b", "runs/20260101-000000-a"]),
    ("noack run lane_following --set loss", ["loss=", "loss.p="]),
    ("noack set loss", ["loss", "loss.p"]),
    ("noack set network.loss", ["network.loss", "network.loss.probability"]),
    ("noack simulate lane_following --tri", ["--trigger"]),
    ("noack simulate lane_following --trigger c", ["continuous"]),
])  # fmt: skip
def test_words_are_completed(
    line: str, offered: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("20260101-000000-a", "20260102-000000-b"):
        (tmp_path / "runs" / name).mkdir(parents=True)
        (tmp_path / "runs" / name / "scenario.toml").touch()
    (tmp_path / "runs" / "campaigns").mkdir()
    (tmp_path / "runs" / "latest").symlink_to("20260102-000000-b")
    assert completed(line) == offered


def test_the_completion_script_of_a_shell_is_printed() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "cosim.cli", "--show-completion", "bash"],
        capture_output=True, text=True, check=True,
        env=os.environ | {"_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"},
    )  # fmt: skip
    assert "_NOACK_COMPLETE=complete_bash" in done.stdout


def test_every_key_is_offered_once_including_those_of_optional_tables() -> None:
    found = keys(Scenario)
    assert len(found) == len(set(found))
    assert {"speed", "trigger.policy", "trigger.sigma", "network.loss.probability",
            "plant.watchdog.policy", "seeds.loss"} <= set(found)  # fmt: skip
