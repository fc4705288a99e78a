"""Live runs of several loops: completeness, lateness, and CPU time per step beside one loop.

A step is one of the plant of one loop: with it come a measurement, a tick of the controller and an
actuation. The CPU time is that of plant, sensor, emulator and controller while the loops run.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks._report import Benchmark, Goal, MeasurementError, Peer, Row, say
from benchmarks.soak.watch import Processes
from cosim.record.run_directory import LATEST, LOOPS, SUMMARY_FILE, read_object
from noack.protocol.topology import LOOP_ROLES

RATES_HZ = (100, 200, 500)
COUNT = 20
_POLL_S = 0.1


class Measured(NamedTuple):
    """A finished run."""

    summaries: list[dict[str, Any]]
    """Of each loop."""
    bit_exact: bool
    cpu_s: float


def run_loops(count: int, rate_hz: int, run_s: float) -> Measured:
    """Run the paper's example as ``count`` loops on one network.

    Raises:
        MeasurementError: the run failed.
    """
    settings = [
        f'loops=[{{name="lane",count={count}}}]', f"horizon_s={run_s}", "ports={}",
        f"plant.rate_hz={rate_hz}", f"controller.rate_hz={rate_hz}",
    ]  # fmt: skip
    with tempfile.TemporaryDirectory(prefix="noack-bench-") as runs:
        command = [sys.executable, "-m", "cosim.cli", "run", "lane_following", "--json", "--runs",
                   runs, *(word for one in settings for word in ("--set", one))]  # fmt: skip
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as run:
            cpu_s = _cpu_s(run, Path(runs) / LATEST)
            output, _ = run.communicate()
        network = json.loads(output)
        if run.returncode != 0:
            why = network.get("error") or network["exit"]["reason"]
            raise MeasurementError(f"{count} loops at {rate_hz} Hz: {why}")
        folders = sorted((Path(runs) / "latest" / LOOPS).iterdir())
        summaries = [read_object(folder / SUMMARY_FILE) for folder in folders]
    replays = [network["replay"], *(one["replay"] for one in summaries)]
    return Measured(summaries, all(one["bit_exact"] for one in replays), cpu_s)


def _cpu_s(run: subprocess.Popen[bytes], started: Path) -> float:
    """Return the CPU time of a run's four processes from its start, when a path exists."""
    processes = Processes(run.pid)
    first: dict[str, float] = {}
    last: dict[str, float] = {}
    while run.poll() is None:
        found = {role: one.cpu_s for role, one in processes.sample().items() if role in LOOP_ROLES}
        if last and not found:
            break
        if started.exists():
            first = first or found
            last |= found
        time.sleep(_POLL_S)
    return sum(last.values()) - sum(first.values())


def rows_of(rate_hz: int, run_s: float, many: Measured, one: Measured) -> list[Row]:
    """Return the rows of a rate: those of many loops, beside one loop."""
    name, nothing = f"{len(many.summaries)} loops at {rate_hz} Hz", Goal("==", 0)
    steps = run_s * rate_hz
    late_us = max(
        part["lateness_us"][role]["p99"] for part in many.summaries
        for role in ("plant", "controller")
    )  # fmt: skip
    missing = sum(part["missing_samples"] for part in many.summaries)
    lost = sum(part["unintended_losses"] for part in many.summaries)
    cpu_us = many.cpu_s / steps / len(many.summaries) * 1e6
    return [
        Row(f"{name}: missing samples", missing, "samples", goal=nothing),
        Row(f"{name}: unintended losses", lost, "datagrams", goal=nothing),
        Row(f"{name}: replay of loops and network not bit-exact", float(not many.bit_exact), "",
            goal=nothing),
        Row(f"{name}: lateness p99, worst loop", late_us * rate_hz / 1e4, "% of the period",
            goal=Goal("<", 100)),
        Row(f"{name}: CPU time of the four processes, per loop and step", cpu_us, "µs",
            Peer("one loop", one.cpu_s / steps * 1e6)),
    ]  # fmt: skip


def measure(options: argparse.Namespace) -> list[Row]:
    """Run many loops and one loop at each rate; of a rate that is too high, say why it failed."""
    run_s, rows = options.many_loops_s, list[Row]()
    for rate_hz in RATES_HZ:
        say(f"{COUNT} loops at {rate_hz} Hz, then one, {run_s:g} s each")
        try:
            many, one = (run_loops(count, rate_hz, run_s) for count in (COUNT, 1))
            rows += rows_of(rate_hz, run_s, many, one)
        except MeasurementError as error:
            rows.append(Row(f"{COUNT} loops at {rate_hz} Hz", None, "", note=str(error)))
    return rows


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare ``--many-loops-s``."""
    parser.add_argument(
        "--many-loops-s", type=float, default=60.0, metavar="SECONDS",
        help="many_loops: length of each run (default: 60)",
    )  # fmt: skip


BENCHMARK = Benchmark("many_loops", "Several loops on one network", measure, add_arguments)
