"""Run the tutorial: write its files, run its commands, and compare its sample output."""

import json
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from typer.testing import CliRunner

from cosim.cli import app
from tests.integration.conftest import wait_for
from tests.pages import fences, target_exists

PAGE = "docs/tutorial.md"
NUMBER = re.compile(r"-?\d[\d,.]*(?:e[-+]?\d+)?")


class Step(NamedTuple):
    """A command of the tutorial, and the output lines that the tutorial shows."""

    command: str
    shown: list[str]


def steps() -> Iterator[Step]:
    step = None
    for language, text in fences(PAGE):
        if language == "sh":
            (command,) = text.splitlines()
            step = Step(command, [])
            yield step
        elif language == "text" and step is not None:
            step.shown.extend(text.splitlines())


def steps_of(program: str, *commands: str) -> list[Step]:
    words = [(step, shlex.split(step.command)) for step in list(steps())]
    return [step for step, (first, second, *_) in words if first == program and second in commands]


def noack(step: Step) -> list[str]:
    return [sys.executable, "-m", "cosim.cli", *shlex.split(step.command)[1:]]


def shape(line: str) -> str:
    """Return the line without numbers and spaces: the column width depends on the numbers."""
    return "".join(NUMBER.sub("0", line).split())


def numbers(line: str) -> list[float]:
    return [float(found[0].strip(".").replace(",", "")) for found in NUMBER.finditer(line)]


def alike(line: str, other: str) -> bool:
    """Whether two output lines agree to 2 %, or both differ from zero by rounding only."""
    return shape(line) == shape(other) and numbers(line) == pytest.approx(
        numbers(other), rel=0.02, abs=1e-12
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for language, text in fences(PAGE):
        if language == "toml" and (named := re.match(r"# (\w+\.toml)\n", text)):
            (tmp_path / named[1]).write_text(text)
    return tmp_path


STILL = steps_of("noack", "check", "simulate", "certify")
MAKE = [step for step in steps() if step.command.startswith("make ")]
LIVE = steps_of("noack", "run", "set")


def test_every_step_is_tested() -> None:
    assert [step.command for step in steps()] == [step.command for step in [*MAKE, *STILL, *LIVE]]
    assert all(target_exists(step.command) for step in MAKE)


@pytest.mark.parametrize("step", STILL, ids=lambda step: step.command)
def test_commands_of_the_tutorial_print_the_shown_output(
    step: Step, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    done = CliRunner().invoke(app, shlex.split(step.command)[1:])
    assert done.exit_code == 0, done.output
    output = done.output.splitlines()
    for line in filter("...".__ne__, step.shown):
        assert any(alike(line, printed) for printed in output), line


def test_the_runtime_parameter_of_the_tutorial_can_be_changed(folder: Path) -> None:
    """One terminal runs the loop; another changes a runtime parameter and then sends SIGINT."""
    run, change = LIVE
    with subprocess.Popen(
        noack(run), cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            wait_for(lambda: (folder / "runs/latest/spool").exists() or process.poll() is not None)
            while process.poll() is None:  # the run may not have begun
                done = subprocess.run(
                    [*noack(change), "--run", "runs/latest"],
                    cwd=folder, capture_output=True, text=True, check=False,
                )  # fmt: skip
                if done.returncode == 0:
                    break
        finally:
            process.send_signal(signal.SIGINT)
            _, stderr = process.communicate(timeout=120)
    assert process.returncode == 130, stderr
    assert [shape(line) for line in change.shown] == [
        shape(line) for line in done.stdout.splitlines()
    ]
    summary = json.loads((folder / "runs/latest/summary.json").read_text())
    (recorded,) = summary["changes"]
    assert recorded["settings"] == {"network.loss.probability": 0.9}
