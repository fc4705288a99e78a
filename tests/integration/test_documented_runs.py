"""Live runs that the documentation shows: two commands, the README's way, the tutorial, an example."""

import doctest
import json
import os
import shlex
import signal
import subprocess
from pathlib import Path

import pytest

import noack
from tests.helpers.command_line import invoke
from tests.helpers.documented_commands import LIVE as LIVE_COMMANDS
from tests.helpers.documented_commands import RUN, run
from tests.helpers.live_runs import WITHOUT_VIEWER, wait_for
from tests.helpers.pages import blocks, fences
from tests.helpers.tutorial import LIVE, alike, program_of, shape, write_files

pytestmark = pytest.mark.live


@pytest.mark.usefixtures("without_viewer", "no_drawing", "no_searches")
@pytest.mark.parametrize("command", [RUN[name] for name in sorted(RUN.keys() & LIVE_COMMANDS)])
def test_one_of_each_command_runs(
    command: str, documented_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(command, documented_folder, monkeypatch)


@pytest.mark.system
@pytest.mark.usefixtures("without_viewer", "no_drawing")
def test_the_way_of_the_readme_leads_from_a_plant_to_a_live_loop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its three commands, in their order: two begin with its first sentence, the third with the second.

    When the loop settles depends on the losses, and whether it does on a machine that is in time.
    """
    monkeypatch.chdir(tmp_path)
    (code,) = blocks("README.md", "python")
    assert blocks("docs/tutorial.md", "python") == [code]  # it goes the same way
    Path("servo.py").write_text(code)
    (way,) = blocks("README.md", "console")
    shown = next(text for language, text in fences("README.md") if text.startswith("angle stays within"))
    for line in way.splitlines():
        _, *words = shlex.split(line.partition("#")[0])
        more = ["--no-report"] if words[0] == "run" else []
        finished = invoke(*words, *more)
        assert finished.exit_code == 0, finished.output
        printed, (guaranteed, happened) = " ".join(finished.stdout.split()), shown.splitlines()
        if words[0] != "run":
            assert alike(printed[: len(guaranteed)], guaranteed)
        elif "conforms until" in printed:
            assert printed.startswith("angle was ")
            assert "late" in printed
        else:
            assert printed.startswith(happened.partition(" from ")[0])


@pytest.mark.system
def test_the_runtime_parameter_of_the_tutorial_can_be_changed(tmp_path: Path) -> None:
    """One terminal runs the loop; another changes a runtime parameter and then sends SIGINT."""
    folder, (running, change) = tmp_path, LIVE
    write_files(folder)
    with subprocess.Popen(
        program_of(running), cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=os.environ | WITHOUT_VIEWER,
    ) as process:  # fmt: skip
        try:
            rows = folder / "runs/latest/spool/plant_step.recorder"
            wait_for(lambda: rows.exists() or process.poll() is not None)
            while process.poll() is None:  # the run may not have begun
                result = subprocess.run(
                    [*program_of(change), "--run", "runs/latest"],
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


@pytest.mark.system
def test_the_example_of_a_live_run_runs() -> None:
    (example,) = doctest.DocTestFinder(recurse=False).find(noack.run, "run", module=False, globs={})
    outcome = doctest.DocTestRunner().run(example)
    assert outcome.attempted > 1
    assert outcome.failed == 0
