"""Many loops through one bottleneck, live: losses, lateness, memory and CPU time.

Each loop samples, computes and applies its input at the same rate. The record is examined where the
processes have left it, in the spool.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import psutil
from numpy.typing import NDArray

from benchmarks._report import Benchmark, Goal, MeasurementError, Row, say
from noack.config.resolution import tables_of
from noack.config.scenario import Scenario
from noack.config.scenario_file import load
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    LOOP,
    NETEM_PACKET,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
)
from noack.protocol.topology import LOOP_ROLES
from noack.runtime.spool import SPOOL, read_chunks

CAP = 2
_SCENARIO = """
name = "fleet"
horizon_s = {horizon_s}
recovery = {{ rejoin_within_s = 0 }}

[model]
name = "double_integrator"

[plant]
initial_state = [1.0, 0.0]
initial_state_halfwidth = [0.5, 0.5]
draw = "uniform"
uncertainty_A = [[0.0, 0.0], [0.2, 0.2]]
rate_hz = {rate_hz}

[controller]
rate_hz = {rate_hz}

[trigger]
beta = 0.5
alpha_per_s = 0.25
floor = 0.02

[network]
mansd = {cap}
loss = {{ model = "bernoulli", probability = 0.3 }}
impairments = [{{ kind = "rate", rate_bps = {rate_bps}, queue = 1000 }}]

[[loops]]
name = "loop"
count = {loops}
"""
_KIBI = 1024


class Load(NamedTuple):
    """The loops of a run."""

    loops: int
    rate_hz: float
    horizon_s: float

    @property
    def samples(self) -> int:
        """Number of measurements of all loops."""
        return self.loops * (round(self.horizon_s * self.rate_hz) + 1)


def scenario_of(load_: Load) -> str:
    """Return the scenario; the bottleneck carries a tenth of all samples."""
    bits = 92 * 8  # an update of two states with its UDP and IP header
    return _SCENARIO.format(
        **load_._asdict(), cap=CAP, rate_bps=int(load_.loops * load_.rate_hz * bits / 10)
    )


class Measured(NamedTuple):
    """A run whose processes have reported."""

    run_dir: Path
    memory_mib: Mapping[str, list[float]]
    """Resident memory over time, by process."""
    cpu_s: Mapping[str, float]


@contextmanager
def run(load_: Load, folder: Path) -> Iterator[Measured]:
    """Run it until all processes have reported; the recorder then waits, and the spool is kept.

    Raises:
        MeasurementError: it did not reach its horizon.
    """
    path = folder / "fleet.toml"
    path.write_text(scenario_of(load_))
    memory, cpu_s = defaultdict[str, list[float]](list), dict[str, float]()
    command = [sys.executable, "-m", "benchmarks._fleet_run", str(path), str(folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        recorder: psutil.Process | None = None
        while process.poll() is None:
            for child in psutil.Process(process.pid).children(recursive=True):
                with suppress(psutil.Error):
                    name = " ".join(child.cmdline())
                    if name.startswith("noack "):
                        memory[name].append(child.memory_info().rss / _KIBI**2)
                        cpu_s[name] = sum(child.cpu_times()[:2])
                        recorder = child if name == "noack recorder" else recorder
            found = [*folder.glob("*/reports.json")]
            if found and len(json.loads(found[0].read_text() or "{}")) == len(LOOP_ROLES):
                break
            time.sleep(0.5)
        else:
            assert process.stdout is not None
            raise MeasurementError(f"the run failed: {process.stdout.read()}")
        if recorder is not None:
            recorder.suspend()
        try:
            yield Measured(found[0].parent, memory, cpu_s)
        finally:
            with suppress(psutil.Error):
                if recorder is not None:
                    recorder.kill()
            process.terminate()


def rows_of(run_dir: Path, scenario: Scenario, table: str) -> NDArray[np.void]:
    """Return the rows of a table in the spool."""
    dtype = tables_of(scenario)[table]
    chunks = dict(read_chunks(run_dir / SPOOL, table))  # a batch may have been sent twice
    return np.concatenate(
        [np.zeros(0, dtype), *(np.frombuffer(chunks[first], dtype) for first in sorted(chunks))]
    )


def figures(load_: Load, folder: Path) -> list[Row]:
    """Return the figures of a run."""
    name = f"{load_.loops:,} loops at {load_.rate_hz:g} Hz, {load_.horizon_s:g} s"
    say(name)
    with run(load_, folder) as measured_run:
        return [row_named(row, f"{name}: {row.name}") for row in _rows(load_, *measured_run)]


def _rows(
    load_: Load, run_dir: Path, memory: Mapping[str, list[float]], cpu_s: Mapping[str, float]
) -> list[Row]:
    scenario = load(run_dir / "scenario.toml")
    reports: dict[str, Any] = json.loads((run_dir / "reports.json").read_text())
    lost = sum(one["channel"]["lost_in_kernel"] or 0 for one in reports.values())
    rejected = sum(sum(one["channel"]["rejected"].values()) for one in reports.values())
    steps, ticks = (rows_of(run_dir, scenario, table) for table in (PLANT_STEP, CONTROLLER_STEP))
    late_ms = [(one["now_ns"] - one["t_ns"]) * 1e-6 for one in (steps, ticks)]
    measured = rows_of(run_dir, scenario, SENSOR_MEASUREMENT)
    deliveries = rows_of(run_dir, scenario, CONTROLLER_DELIVERY)
    packets = rows_of(run_dir, scenario, NETEM_PACKET)
    burst = int(deliveries["dropouts"].max(initial=0))
    growth = max(max(one[len(one) // 2 :]) - one[len(one) // 2] for one in memory.values())
    total_s = sum(cpu_s.values())
    period_ms = 1e3 / load_.rate_hz
    return [
        Row("samples", len(steps), "", note=f"{len(np.unique(steps[LOOP]))} loops"),
        Row("missing samples", load_.samples - len(measured), "", goal=Goal("==", 0)),
        Row("missing ticks", load_.samples - load_.loops - len(ticks), "", goal=Goal("==", 0)),
        Row("unintended losses", lost + rejected, "", goal=Goal("==", 0)),
        Row("longest loss burst", burst, "", goal=Goal("<=", CAP)),
        Row("updates", len(packets), "", note=f"{len(packets) / load_.horizon_s:.0f} /s"),
        Row("plant lateness, p99", float(np.percentile(late_ms[0], 99)), "ms",
            goal=Goal("<", period_ms), note=f"max {late_ms[0].max():.1f} ms"),
        Row("controller lateness, p99", float(np.percentile(late_ms[1], 99)), "ms",
            goal=Goal("<", period_ms), note=f"max {late_ms[1].max():.1f} ms"),
        Row("CPU time of all processes", total_s / load_.horizon_s, "s/s",
            note=", ".join(f"{k.removeprefix('noack ')} {v:.1f} s" for k, v in cpu_s.items())),
        Row("CPU time per loop and step", total_s / load_.samples * 1e6, "µs"),
        Row("growth of memory in the second half", growth, "MiB",
            note=", ".join(
                f"{k.removeprefix('noack ')} {v[len(v) // 2]:.0f}–{v[-1]:.0f}"
                for k, v in memory.items()
            )),
    ]  # fmt: skip


def row_named(row: Row, name: str) -> Row:
    """Return a row with another name."""
    return Row(name, row.value, row.unit, row.peer, row.goal, row.note)


def options(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument("--fleet-s", type=float, default=60.0, help="length of the runs, seconds")
    parser.add_argument("--fleet-loops", type=int, default=1000, help="loops at 50 Hz")


def measure(options: argparse.Namespace) -> list[Row]:
    """Measure both loads."""
    found = []
    for load_ in (
        Load(options.fleet_loops, 50.0, options.fleet_s),
        Load(20, 500.0, options.fleet_s),
    ):
        with tempfile.TemporaryDirectory() as folder:
            found += figures(load_, Path(folder))
    return found


BENCHMARK = Benchmark("fleet", "Many loops on one network", measure, options)
