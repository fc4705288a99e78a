"""``make demo`` from a clean clone of this repository to its verdict, with the installation."""

import argparse
import os
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

from benchmarks._report import Benchmark, Goal, MeasurementError, Row, say

ROOT = Path(__file__).parents[1]
_PATIENCE_S = 900.0


def measure(options: argparse.Namespace) -> list[Row]:
    """Clone the last commit, and run the demo; 20 s of it are the run."""
    with tempfile.TemporaryDirectory(prefix="noack-bench-") as folder:
        say("make demo from a clean clone")
        clone = Path(folder) / "noack"
        subprocess.run(["git", "clone", "-q", str(ROOT), str(clone)], check=True)
        begun_s = time.monotonic()
        done = subprocess.run(
            ["make", "demo"], cwd=clone, capture_output=True, text=True, check=False,
            timeout=_PATIENCE_S, env=os.environ | {"VIRTUAL_ENV": ""},
        )  # fmt: skip
        spent_s = time.monotonic() - begun_s
    if done.returncode:
        raise MeasurementError(
            f"make demo: {(done.stderr.strip() or 'no message').splitlines()[-1]}"
        )
    compiler = "gcc present" if shutil.which("cc") else "no C compiler"
    return [Row(f"make demo from a clean clone to its verdict, {compiler}", spent_s, "s",
                goal=Goal("<=", 60))]  # fmt: skip


BENCHMARK = Benchmark("clone", "The demo from a clean clone", measure)
