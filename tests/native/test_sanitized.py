"""The core does nothing that is undefined in C: it runs with ASan and UBSan, in a child process."""

import re
import subprocess
from pathlib import Path

import pytest

from tests.native import sanitized_core

pytestmark = pytest.mark.system
ROOT = sanitized_core.ROOT
PYTEST = ("pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-s", "--hypothesis-profile=few")


def run(*module: str) -> subprocess.CompletedProcess[str]:
    """Run a module in a process that has the core with sanitizers; skip if there can be none."""
    try:
        command, environment = sanitized_core.command(*module)
    except sanitized_core.NoSanitizersError as error:
        pytest.skip(str(error))
    return subprocess.run(
        command, env=environment, cwd=ROOT, capture_output=True, text=True, check=False, timeout=500
    )


FILES = [
    str(path.relative_to(ROOT))
    for path in sorted((ROOT / "tests").rglob("*.py"))
    if "pytest.mark.sanitized" in path.read_text(encoding="utf-8") and path != Path(__file__)
]
"""The files whose tests, or some of them, have the mark: those that reach other parts of the core."""


def test_the_tests_of_the_core_run_clean_under_sanitizers() -> None:
    """One process for all of them: with sanitizers, its start takes as long as many tests."""
    done = run(*PYTEST, *FILES, "-m", "sanitized")
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[:4000]
    (passed,) = re.findall(r"^(\d+) passed", done.stdout, re.MULTILINE)
    assert int(passed) >= 77
