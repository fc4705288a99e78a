"""What is installed and what is maintained: bytes of the installation, lines of code."""

import argparse
import re
import subprocess
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from benchmarks._report import Benchmark, Goal, Row

ROOT = Path(__file__).parents[1]
PROGRAM = ("noack", "netem", "cosim", "plant_server", "sensor_node", "controller_node")


def installed_bytes(names: Iterable[str]) -> int:
    """Return the bytes of the files of installed distributions."""
    total = 0
    for name in names:
        try:
            files = distribution(name).files or ()
        except PackageNotFoundError:  # only on other systems or versions of Python
            continue
        total += sum(path.stat().st_size for one in files if (path := Path(one.locate())).is_file())
    return total


def locked(file: str) -> set[str]:
    """Return the names of the distributions of a lock file."""
    return set(re.findall(r"^([A-Za-z0-9_.-]+)==", (ROOT / file).read_text(), re.M))


def lines(patterns: Iterable[str]) -> int:
    """Return the lines of the files that git knows."""
    command = ["git", "ls-files", "-z", "--", *patterns]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    files = [ROOT / name for name in listed.split("\0") if name]
    return sum(len(file.read_bytes().splitlines()) for file in files if file.is_file())


def measure(options: argparse.Namespace) -> list[Row]:
    """Count."""
    default = locked("requirements.lock")
    compiler_bytes = installed_bytes(default & {"numba", "llvmlite"})
    python = lines([f"{folder}/*.py" for folder in PROGRAM])
    with_benchmarks = python + lines(["benchmarks/*.py"])
    return [
        Row("installed without extras", installed_bytes(default) / 1e6, "MB"),
        Row("of it, numba and llvmlite", compiler_bytes / 1e6, "MB", goal=Goal("==", 0)),
        Row("Python outside tests", python, "lines", goal=Goal("<=", 75_000)),
        Row("the same, with benchmarks", with_benchmarks, "lines", goal=Goal("<=", 64_000)),
        Row("C", lines(["native/*.c", "native/*.h"]), "lines", goal=Goal("<=", 5_000)),
    ]  # fmt: skip


BENCHMARK = Benchmark("size", "Installation and code", measure)
