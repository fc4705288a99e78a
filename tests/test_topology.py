import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_imports_go_down_only_and_the_four_processes_do_not_import_each_other() -> None:
    """import-linter finds no violation of the contracts in ``pyproject.toml``."""
    answer = subprocess.run(
        [Path(sys.executable).with_name("lint-imports"), "--no-cache"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert answer.returncode == 0, answer.stdout + answer.stderr
    assert "Contracts: 8 kept, 0 broken." in answer.stdout
