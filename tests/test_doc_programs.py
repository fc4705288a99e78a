"""Run the snippets and programs of the documentation, the way of the README, and the tutorial."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from runpy import run_path
from typing import NamedTuple

import pytest

from tests.helpers.command_line import invoke
from tests.helpers.live_runs import WITHOUT_VIEWER, wait_for
from tests.helpers.pages import ROOT, blocks, fences, target_exists

pytestmark = pytest.mark.system
EXAMPLES = ROOT / "docs/examples"
FIGURES = {
    "own_plant": {"own_plant.svg", "own_plant_errors.svg"},
    "model_or_hold": {"model_or_hold.svg"},
}


def snippets() -> list[str]:
    """Return programs; a snippet that begins with a file name is a file instead."""
    pages = ("docs/plants.md", "docs/record.md", "docs/library.md", "docs/howto.md")
    programs = [code for page in pages for code in blocks(page, "python")]
    return [snippet for snippet in programs if not snippet.startswith("#")]


@pytest.mark.usefixtures("without_viewer", "no_searches")
@pytest.mark.parametrize("snippet", snippets())
def test_every_snippet_runs(
    snippet: str, documented_folder: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(documented_folder)
    exec(compile(snippet, "snippet", "exec"), {"__name__": "__main__"})
    assert capsys.readouterr().out.strip()


@pytest.mark.usefixtures("no_searches")
@pytest.mark.parametrize("name", FIGURES)
def test_an_example_runs_and_leaves_its_figures(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
    printed, errors = capfd.readouterr()
    assert not errors
    assert printed
    assert {path.name for path in tmp_path.iterdir()} == FIGURES[name]


def test_the_tests_of_a_page_pass(tmp_path: Path) -> None:
    """The page "Test your controller" has files that belong into one folder."""
    for code in blocks("docs/testing.md", "python"):
        name = re.match(r"# (\w+\.py)\n", code)
        assert name is not None
        (tmp_path / name[1]).write_text(code)
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "-p",
        "no:xdist",
        str(tmp_path),
    ]
    finished = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=600)
    assert finished.returncode == 0, finished.stdout


@pytest.mark.live
@pytest.mark.usefixtures("without_viewer", "no_drawing")
def test_the_way_of_the_readme_leads_from_a_plant_to_a_live_loop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its three commands, in their order; the first line of two of them is the sentence that it shows."""
    monkeypatch.chdir(tmp_path)
    (code,) = blocks("README.md", "python")
    assert blocks("docs/tutorial.md", "python") == [code]  # it goes the same way
    Path("servo.py").write_text(code)
    (way,) = blocks("README.md", "console")
    shown = next(text for language, text in fences("README.md") if text.startswith("angle stays within"))
    for line in way.splitlines():
        _, *words = shlex.split(line.partition("#")[0])
        more = ["--no-report", "--set=speed=4"] if words[0] == "run" else []
        finished = invoke(*words, *more)
        assert finished.exit_code == 0, finished.output
        if words[0] != "run":
            assert alike(" ".join(finished.stdout.split())[: len(shown)].strip(), shown.strip())
        else:
            assert finished.stdout.startswith("angle was within 0.02 rad of its set-point")


# --- the tutorial ---------------------------------------------------------------------------------

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
    return [float(match[0].strip(".").replace(",", "")) for match in NUMBER.finditer(line)]


def alike(line: str, other: str) -> bool:
    """Whether two output lines agree to 2 %, or both differ from zero by rounding only."""
    return shape(line) == shape(other) and numbers(line) == pytest.approx(numbers(other), rel=0.02, abs=1e-12)


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
    result = invoke(*shlex.split(step.command)[1:])
    assert result.exit_code == 0, result.output
    output = result.output.splitlines()
    for line in filter("...".__ne__, step.shown):
        assert any(alike(line, printed) for printed in output), line


@pytest.mark.live
def test_the_runtime_parameter_of_the_tutorial_can_be_changed(folder: Path) -> None:
    """One terminal runs the loop; another changes a runtime parameter and then sends SIGINT."""
    run, change = LIVE
    with subprocess.Popen(
        noack(run), cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=os.environ | WITHOUT_VIEWER,
    ) as process:  # fmt: skip
        try:
            rows = folder / "runs/latest/spool/plant_step.recorder"
            wait_for(lambda: rows.exists() or process.poll() is not None)
            while process.poll() is None:  # the run may not have begun
                result = subprocess.run(
                    [*noack(change), "--run", "runs/latest"],
                    cwd=folder, capture_output=True, text=True, check=False,
                )  # fmt: skip
                if result.returncode == 0:
                    break
        finally:
            process.send_signal(signal.SIGINT)
            _, stderr = process.communicate(timeout=120)
    assert process.returncode == 130, stderr
    assert [shape(line) for line in change.shown] == [shape(line) for line in result.stdout.splitlines()]
    summary = json.loads((folder / "runs/latest/summary.json").read_text())
    (recorded,) = summary["changes"]
    assert recorded["settings"] == {"network.loss.probability": 0.9}
