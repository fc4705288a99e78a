"""Many loops through one bottleneck, live: losses, lateness, memory, replay, CPU time.

Each loop samples, computes and applies its input at the same rate. A step is one of the plant of
one loop: with it come a measurement, a tick of the controller and an actuation. The CPU time is
that of plant, sensor, emulator and controller while the loops run. Their alternative is one loop
alone, and that of their memory as many Pythons that import the libraries of each process.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import psutil

from benchmarks._report import Benchmark, Goal, MeasurementError, Peer, Row, median, say
from benchmarks.soak.watch import Processes
from cosim.record.run_directory import LATEST
from noack.protocol.topology import LOOP_ROLES, WITH_DEADLINES

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
_POLL_S = 2.0
_SINGLE_S = 60.0
_FLAT_MIB = 32.0
_STEP_US, _MEMORY_MIB, _END_SHARE = Goal("<=", 5), Goal("<=", 80), Goal("<=", 0.1)
_LATE_MS = {50.0: Goal("<=", 1.0), 500.0: Goal("<=", 0.3)}
"""By the rate of the loops, Hz."""
_LIBRARIES = "import numpy, zenoh; print(); input()"


class Load(NamedTuple):
    """The loops of a run."""

    loops: int
    rate_hz: float
    horizon_s: float

    def __str__(self) -> str:
        plural = "s" if self.loops > 1 else ""
        return f"{self.loops:,} loop{plural} at {self.rate_hz:g} Hz, {self.horizon_s:g} s"

    def step_us(self, measured: "Measured") -> float:
        """CPU time of the processes per loop and step."""
        return sum(measured.cpu_s.values()) / (self.loops * self.horizon_s * self.rate_hz) * 1e6


def scenario_of(load_: Load) -> str:
    """Return the scenario.

    The bottleneck carries what the guarantee demands even if every sample is an event. A slower one
    would stay congested after a stall of the computer: late updates cause events, events delays.
    """
    bits = 92 * 8  # an update of two states with its UDP and IP header
    rate_bps = int(load_.loops * load_.rate_hz * bits / (CAP + 1))
    return _SCENARIO.format(**load_._asdict(), cap=CAP, rate_bps=rate_bps)


class Measured(NamedTuple):
    """A finished run."""

    network: dict[str, Any]
    """The summary of the run."""
    loops: list[dict[str, Any]]
    """The summary of each loop."""
    memory_mib: Mapping[str, list[float]]
    """Private memory over time, by process."""
    cpu_s: Mapping[str, float]
    """By process, while the loops ran."""
    end_s: float
    """Wall time from the end of the loops to the end of the command."""


def run(load_: Load, folder: Path) -> Measured:
    """Run the loops as a user does.

    Raises:
        MeasurementError: the run failed.
    """
    path = folder / "fleet.toml"
    path.write_text(scenario_of(load_))
    command = [sys.executable, "-m", "cosim.cli", "run", str(path), "--json", "--no-report",
               "--runs", str(folder)]  # fmt: skip
    with (folder / "output").open("w+") as output:
        with subprocess.Popen(command, stdout=output, stderr=subprocess.DEVNULL) as process:
            memory, cpu_s, end_s = _follow(process, folder / LATEST)
        output.seek(0)
        network = json.loads(output.read() or "{}")
    if process.returncode != 0:
        found = network.get("exit", {}).get("reason", network.get("error"))
        raise MeasurementError(f"{load_.loops} loops at {load_.rate_hz:g} Hz: {found}")
    return Measured(network, network["loops"], memory, cpu_s, end_s)


def _follow(
    process: subprocess.Popen[bytes], started: Path
) -> tuple[dict[str, list[float]], dict[str, float], float]:
    """Return memory and CPU time of a run's processes from its start, when a path exists."""
    processes = Processes(process.pid)
    memory = defaultdict[str, list[float]](list)
    first, last = dict[str, float](), dict[str, float]()
    ended_s = time.monotonic()
    while process.poll() is None:
        if started.exists():
            for role, one in processes.sample().items():
                memory[role].append(one.uss_kib / _KIBI)
                if role in LOOP_ROLES:
                    first.setdefault(role, one.cpu_s)
                    last[role] = one.cpu_s
                    ended_s = time.monotonic()
        time.sleep(_POLL_S)
    cpu_s = {role: last[role] - first[role] for role in last}
    return memory, cpu_s, time.monotonic() - ended_s


def figures(load_: Load, found: Measured, single_us: float) -> list[Row]:
    """Return the figures of a run; ``single_us`` is the CPU time of a step of one loop alone."""
    loops, network = found.loops, found.network
    nothing, step_us = Goal("==", 0), load_.step_us(found)
    equal = [one["replay"]["bit_exact"] for one in (network["network"], *loops)].count(True)
    late = {
        role: max(one["lateness_us"][role]["p99"] for one in loops) * 1e-3
        for role in WITH_DEADLINES
    }
    loop_memory = {role: mib for role, mib in found.memory_mib.items() if role in LOOP_ROLES}
    growth = max(mib[-1] - mib[len(mib) // 2] for mib in loop_memory.values())
    rows = [
        Row("missing samples", sum(one["missing_samples"] for one in loops), "", goal=nothing),
        Row("unintended losses", sum(one["unintended_losses"] for one in loops), "", goal=nothing),
        Row("longest loss burst", max(one["longest_loss_burst"] for one in loops), "",
            goal=Goal("<=", CAP)),
        Row("updates", network["network"]["datagrams"] / load_.horizon_s, "/s"),
        *(
            Row(f"{role} lateness p99, worst loop", late_ms, "ms", goal=_LATE_MS[load_.rate_hz])
            for role, late_ms in late.items()
        ),
        Row("loops and network not replayed bit for bit", 1 + len(loops) - equal, "",
            goal=nothing),
        Row("CPU time per loop and step", step_us, "µs", goal=_STEP_US,
            note=", ".join(f"{role} {used_s:.1f} s" for role, used_s in found.cpu_s.items())),
        Row("the same", step_us, "µs", Peer("one loop alone", single_us)),
        Row("growth of memory in the second half, worst process", growth, "MiB",
            goal=Goal("<", _FLAT_MIB),
            note=", ".join(
                f"{role} {mib[len(mib) // 2]:.0f}–{mib[-1]:.0f}"
                for role, mib in found.memory_mib.items()
            )),
        Row("end of the run", found.end_s, "s", Peer("the run", load_.horizon_s), _END_SHARE),
    ]  # fmt: skip
    return [replace(row, name=f"{load_}: {row.name}") for row in rows]


def memory(load_: Load, found: Measured) -> list[Row]:
    """Return the private memory of the processes of one loop: the median over its run."""
    used = {role: median(found.memory_mib[role]) for role in LOOP_ROLES}
    name = f"{load_}: private memory of {', '.join(used)}"
    note = ", ".join(f"{role} {mib:.0f}" for role, mib in used.items())
    peer = Peer("as many Pythons that import numpy and zenoh", libraries_mib(len(used)))
    total = sum(used.values())
    return [
        Row(name, total, "MiB", goal=_MEMORY_MIB, note=note),
        Row("the same", total, "MiB", peer),
    ]


def libraries_mib(count: int) -> float:
    """Return the private memory of so many Pythons at once that import the libraries."""
    with ExitStack() as stack:
        pythons = [
            stack.enter_context(
                subprocess.Popen(
                    [sys.executable, "-c", _LIBRARIES],
                    stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                )
            )
            for _ in range(count)
        ]  # fmt: skip
        for python in pythons:
            assert python.stdout is not None
            python.stdout.readline()
        used = [psutil.Process(python.pid).memory_full_info().uss for python in pythons]
        for python in pythons:
            python.kill()
    return float(sum(used)) / _KIBI**2


def options(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument("--fleet-s", type=float, default=60.0, help="length of the runs, seconds")
    parser.add_argument("--fleet-loops", type=int, default=1000, help="loops at 50 Hz")
    parser.add_argument("--fleet-dir", type=Path, help="where the runs are kept meanwhile")


def measure(options: argparse.Namespace) -> list[Row]:
    """Measure both loads, and one loop at the rates of both."""
    rows = []
    for load_ in (
        Load(options.fleet_loops, 50.0, options.fleet_s),
        Load(20, 500.0, options.fleet_s),
    ):
        single = load_._replace(loops=1, horizon_s=min(load_.horizon_s, _SINGLE_S))
        measured = []
        for one in (single, load_):
            say(str(one))
            with tempfile.TemporaryDirectory(dir=options.fleet_dir) as folder:
                measured.append(run(one, Path(folder)))
        alone, together = measured
        rows += figures(load_, together, single.step_us(alone))
        if load_.rate_hz != 50.0:
            rows += memory(single, alone)
    return rows


BENCHMARK = Benchmark("fleet", "Many loops on one network", measure, options)
