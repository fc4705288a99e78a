"""Time from the start of ``noack run`` to the first control step; on request, from a bare system.

The first control step is read off the progress lines (:func:`benchmarks._runs.first_step_s`), which
bounds it from above. The alternative is a Python that does no more than import the libraries that
every process of a run needs. ``--install`` also copies the repository's files into an empty folder
and runs ``make demo`` there: a new environment, the pinned dependencies, the first run.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks._report import Benchmark, Goal, MeasurementError, Peer, Row, median, run, say
from benchmarks._runs import FREE_PORTS, execute, first_step_s, noack

ROUNDS = 5
GOAL_S = Goal("<", 3)
ROOT = Path(__file__).parents[1]

_LIBRARIES = "import numpy, scipy.linalg, pydantic, zenoh"
_SHORT = ("--set", "horizon_s=1")


def started_s() -> float:
    """Wall seconds from the start of ``noack run`` to the first control step.

    Raises:
        MeasurementError: the run failed or showed no progress.
    """
    bound_s = noack("run", "lane_following", *_SHORT).first_step_s
    if bound_s is None:
        raise MeasurementError("the run showed no progress line")
    return bound_s


def imported_s() -> float:
    """Wall seconds that a bare Python takes to import the libraries and end."""
    begun_s, at_end_s = _span([sys.executable, "-c", f"{_LIBRARIES}; {_STAMP}"])
    return at_end_s - begun_s


_STAMP = "import sys, time; print(time.monotonic(), file=sys.stderr)"


def _span(command: list[str]) -> tuple[float, float]:
    finished = execute(command)
    return finished.begun_s, float(finished.lines[-1].text)


def copy_repository(target: Path) -> None:
    """Copy the repository's own files, as they are now, and nothing that was made from them.

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
        MeasurementError: it failed or showed no progress.
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


def measure(options: argparse.Namespace) -> list[Row]:
    """Start several short runs, and the alternative in turn."""
    ours_s, imports_s = [], []
    for number in range(ROUNDS):
        say(f"round {number + 1} of {ROUNDS}")
        ours_s.append(started_s())
        imports_s.append(imported_s())
    value_s, peer_s = median(ours_s), median(imports_s)
    rows = [
        Row("noack run → first control step", value_s, "s", goal=GOAL_S,
            note="upper bound: includes a progress line's way through the recorder"),
        Row("noack run → first control step, per import", value_s, "s",
            Peer("Python that imports the libraries", peer_s)),
    ]  # fmt: skip
    if options.install:
        say("make demo in an empty folder")
        rows.append(Row("make demo → first control step", installed_s(), "s", note=_pip_note()))
    return rows


def _pip_note() -> str:
    return "downloads included, unless pip had them in its cache"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare ``--install``."""
    parser.add_argument(
        "--install", action="store_true",
        help="startup: also time `make demo` from an empty folder (makes an environment)",
    )  # fmt: skip


BENCHMARK = Benchmark("startup", "Time to the first control step", measure, add_arguments)

if __name__ == "__main__":
    sys.exit(run([BENCHMARK]))
