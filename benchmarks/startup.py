"""Time from the start of ``noack run`` to the first control step; optionally, with installation.

The progress lines give an upper bound of this time (:func:`benchmarks._runs.first_step_s`). The
alternative is a Python that only imports the libraries that every process of a run needs.
``--install`` also copies the repository's files into an empty folder and runs ``make demo`` there:
a new environment, the pinned dependencies, the first run.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from benchmarks._report import Benchmark, Goal, MeasurementError, Peer, Row, median, say
from benchmarks._runs import FREE_PORTS, execute, first_step_s, noack

ROUNDS = 5
GOAL_S = Goal("<", 3)
ROOT = Path(__file__).parents[1]

_IMPORT_LIBRARIES = (
    "import numpy, scipy.linalg, pydantic, zenoh, sys; print('ready', file=sys.stderr)"
)
_SHORT = ("--set", "horizon_s=1")


def started() -> tuple[float, float | None]:
    """Start a short run.

    Returns:
        Wall seconds from the start of ``noack run`` to the first control step, and the launch time
        from the run's summary, if it has one.

    Raises:
        MeasurementError: the run failed or printed no progress.
    """
    found = noack("run", "lane_following", *_SHORT)
    if found.first_step_s is None:
        raise MeasurementError("the run showed no progress line")
    return found.first_step_s, found.summary.get("startup_s")


def imported_s() -> float:
    """Return wall seconds from the start of a bare Python to the end of the libraries' import."""
    finished = execute([sys.executable, "-c", _IMPORT_LIBRARIES])
    return finished.lines[-1].at_s - finished.begun_s


def copy_repository(target: Path) -> None:
    """Copy the repository's own files in their present state, without generated files.

    Raises:
        MeasurementError: this is not a git repository.
    """
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode != 0:
        raise MeasurementError(f"git ls-files: {listed.stderr.strip()}")
    for name in filter(None, listed.stdout.split("\0")):
        source = ROOT / name
        if source.is_file():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, target / name)


def installed_s() -> float:
    """Wall seconds from ``make demo`` in a fresh copy of the repository to the first control step.

    Raises:
        MeasurementError: it failed or printed no progress.
    """
    if shutil.which("make") is None:
        raise MeasurementError("make is not installed")
    with tempfile.TemporaryDirectory(prefix="noack-install-") as folder:
        copy_repository(Path(folder))
        arguments = " ".join((*_SHORT, *FREE_PORTS))
        finished = execute(["make", "demo", f"ARGS={arguments}"], cwd=Path(folder))
    bound_s = first_step_s(finished.begun_s, finished.lines)
    if bound_s is None:
        raise MeasurementError("make demo showed no progress line")
    return bound_s


def rows_of(
    ours_s: Sequence[float], launches_s: Sequence[float], imports_s: Sequence[float]
) -> list[Row]:
    """Return the rows from the rounds of both sides, wall seconds."""
    value_s = median(ours_s)
    rows = [
        Row("noack run → first control step", value_s, "s", goal=GOAL_S,
            note="upper bound: includes a progress line's way through the recorder"),
        Row("the same, against a bare import", value_s, "s",
            Peer("Python that imports the libraries", median(imports_s))),
    ]  # fmt: skip
    if launches_s:
        rows.append(Row("of it, from launch to time 0, as the run says", median(launches_s), "s"))
    return rows


def measure(options: argparse.Namespace) -> list[Row]:
    """Start several short runs, and the alternative in turn."""
    ours_s, launches_s, imports_s = [], [], []
    for number in range(ROUNDS):
        say(f"round {number + 1} of {ROUNDS}")
        total_s, launch_s = started()
        ours_s.append(total_s)
        imports_s.append(imported_s())
        if launch_s is not None:
            launches_s.append(launch_s)
    rows = rows_of(ours_s, launches_s, imports_s)
    if options.install:
        say("make demo in an empty folder")
        note = "a new environment and the pinned dependencies; downloaded, or from pip's cache"
        rows.append(Row("make demo → first control step", installed_s(), "s", note=note))
    return rows


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare ``--install``."""
    parser.add_argument(
        "--install", action="store_true",
        help="startup: also time `make demo` from an empty folder (makes an environment)",
    )  # fmt: skip


BENCHMARK = Benchmark("startup", "Time to the first control step", measure, add_arguments)
