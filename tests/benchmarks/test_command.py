"""The command line of the benchmarks, where the tests' helpers are not installed."""

import subprocess
import sys
from pathlib import Path

import pytest

import benchmarks

BLOCKED = """
import runpy, sys

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("pytest", "_pytest", "hypothesis"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Blocked())
runpy.run_module("benchmarks", run_name="__main__")
"""


@pytest.mark.parametrize("words", [["--list"], ["latency"]])
def test_without_pytest_one_line_says_what_to_install(words: list[str]) -> None:
    root = Path(benchmarks.__file__).parents[1]
    process = subprocess.run(
        [sys.executable, "-c", BLOCKED, *words], cwd=root, capture_output=True, text=True, check=False
    )
    (line,) = process.stderr.splitlines()
    assert process.returncode != 0
    assert "pytest" in line
    assert "`make setup-dev`" in line
