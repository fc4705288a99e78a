import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_imports_go_down_only_and_the_four_processes_know_nothing_of_each_other() -> None:
    """The contracts of ``pyproject.toml``, as import-linter finds them."""
    answer = subprocess.run(
        [Path(sys.executable).with_name("lint-imports"), "--no-cache"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert answer.returncode == 0, answer.stdout + answer.stderr
    assert "Contracts: 6 kept, 0 broken." in answer.stdout
