"""Fixture: tshark checks the written files."""

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

Tshark = Callable[..., str]


@pytest.fixture
def tshark(tmp_path: Path) -> Tshark:
    """Run tshark on a file and return its output; it must report no error."""
    program = shutil.which("tshark")
    if program is None:
        pytest.skip("tshark is not installed")

    def run(capture: Path, *arguments: str) -> str:
        done = subprocess.run(
            [
                program, "-n", "-r", str(capture),
                "-o", "udp.check_checksum:TRUE", "-o", "ip.check_checksum:TRUE", *arguments,
            ],
            env={"HOME": str(tmp_path), "LC_ALL": "C.UTF-8", "PATH": "/usr/bin:/bin"},
            capture_output=True, text=True, check=False, timeout=60,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        complaints = [line for line in done.stderr.splitlines() if "dangerous" not in line]
        assert complaints == []
        return done.stdout

    return run
