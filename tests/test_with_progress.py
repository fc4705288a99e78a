"""What make prints while something takes long: a line at once, and further ones until it ends."""

import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
run = runpy.run_path(str(ROOT / "tools" / "with_progress.py"))["run"]


def python(code: str) -> list[str]:
    return [sys.executable, "-c", code]


@pytest.mark.parametrize("is_late", [False, True])
def test_lines_say_that_the_command_still_runs(is_late: bool, capfd: pytest.CaptureFixture[str]) -> None:
    assert run("waiting", python("import time; time.sleep(1)"), is_late=is_late, every_s=0.05) == 0
    first, *others = capfd.readouterr().out.splitlines()
    assert (first == "waiting ...") != is_late
    assert others
    assert all(re.fullmatch(r"waiting: \d+ s so far", line) for line in others)


@pytest.mark.parametrize(("code", "status"), [
    ("print('made')", 0), ("print('made'); exit(3)", 3),
    ("print('made', flush=True); import os; os.kill(os.getpid(), 9)", 137),
])  # fmt: skip
@pytest.mark.parametrize("options", [[], ["--late"]])
def test_output_and_exit_status_are_those_of_the_command(code: str, status: int, options: list[str]) -> None:
    command = [sys.executable, "tools/with_progress.py", *options, "making it", *python(code)]
    process = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert process.returncode == status
    assert process.stdout.splitlines() == [*([] if options else ["making it ..."]), "made"]
    assert process.stderr == ""


def test_nothing_that_takes_long_is_silent_in_the_makefile() -> None:
    """What installs, builds or checks without a word of its own has lines about it."""
    text = (ROOT / "Makefile").read_text(encoding="utf-8").replace("\\\n", " ")
    recipes = [line for line in text.splitlines() if line.startswith("\t")]
    parts = [part for line in recipes for part in re.split(r"&& |\|\| |; | & ", line)]
    silent = ("$(PIP)", "$(EDITABLE)", "uv build", "uv pip compile", "compileall", "/mypy", "sphinx-build")
    long = [part for part in parts if any(word in part for word in silent)]
    assert len(long) > 12
    assert [part for part in long if "$(SAY)" not in part] == []
