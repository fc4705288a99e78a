"""Run the snippets and programs of the documentation, and the tutorial but for its live run."""

import re
import shlex
import subprocess
import sys
from pathlib import Path
from runpy import run_path

import pytest

from tests.helpers.command_line import invoke
from tests.helpers.pages import ROOT, blocks, target_exists
from tests.helpers.tutorial import LIVE, MAKE, STILL, Step, alike, steps, write_files

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


def test_every_step_of_the_tutorial_is_tested() -> None:
    assert [step.command for step in steps()] == [step.command for step in [*MAKE, *STILL, *LIVE]]
    assert all(target_exists(step.command) for step in MAKE)


@pytest.mark.parametrize("step", STILL, ids=lambda step: step.command)
def test_commands_of_the_tutorial_print_the_shown_output(
    step: Step, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_files(tmp_path)
    monkeypatch.chdir(tmp_path)
    result = invoke(*shlex.split(step.command)[1:])
    assert result.exit_code == 0, result.output
    output = result.output.splitlines()
    for line in filter("...".__ne__, step.shown):
        assert any(alike(line, printed) for printed in output), line
