"""Many loops through one bottleneck, live: losses, lateness, memory, replay, CPU time.

Each loop samples, computes and applies its input at the same rate. A step is one of the plant of
one loop: with it come a measurement, a tick of the controller and an actuation. The CPU time is
that of plant, sensor, emulator and controller while the loops run.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks._report import Benchmark, Goal, MeasurementError, Peer, Row, say
from benchmarks._stolen_time import StolenTime, began_s, worst_p99_us
from benchmarks.soak.watch import Processes
from cosim.record.run_directory import LATEST
from cosim.simulation.shared_network import simulate_loops
from noack.config.scenario_file import load
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
_BATCH = 50, 10.0
"""Loops, and seconds, of a run in virtual time."""


class Load(NamedTuple):
    """The loops of a run."""

    loops: int
    rate_hz: float
    horizon_s: float

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
    quiet_s: int
    """Number of seconds of the run in which the hypervisor took nothing."""
    quiet_p99_ms: Mapping[str, float]
    """Lateness p99 in these seconds, of the worst loop, by process."""


def run(load_: Load, folder: Path) -> Measured:
    """Run the loops as a user does.

    Raises:
        MeasurementError: the run failed.
    """
    path = folder / "fleet.toml"
    path.write_text(scenario_of(load_))
    command = [sys.executable, "-m", "cosim.cli", "run", str(path), "--json", "--no-report",
               "--runs", str(folder)]  # fmt: skip
    stolen = StolenTime()
    with (folder / "output").open("w+") as output:
        with subprocess.Popen(command, stdout=output, stderr=subprocess.DEVNULL) as process:
            memory, cpu_s, end_s = _follow(process, folder / LATEST, stolen)
        output.seek(0)
        network = json.loads(output.read() or "{}")
    if process.returncode != 0:
        found = network.get("exit", {}).get("reason", network.get("error"))
        raise MeasurementError(f"{load_.loops} loops at {load_.rate_hz:g} Hz: {found}")
    quiet = stolen.quiet_seconds(began_s(folder / LATEST), load_.horizon_s)
    late_ms = {role: worst_p99_us(folder / LATEST, role, quiet) * 1e-3 for role in WITH_DEADLINES}
    return Measured(network, network["loops"], memory, cpu_s, end_s, len(quiet), late_ms)


def _follow(
    process: subprocess.Popen[bytes], started: Path, stolen: StolenTime
) -> tuple[dict[str, list[float]], dict[str, float], float]:
    """Return memory and CPU time of a run's processes from its start, when a path exists."""
    processes = Processes(process.pid)
    memory = defaultdict[str, list[float]](list)
    first, last = dict[str, float](), dict[str, float]()
    ended_s = time.monotonic()
    while process.poll() is None:
        stolen.sample()
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
    nothing, period_ms = Goal("==", 0), 1e3 / load_.rate_hz
    unequal = [one["replay"]["bit_exact"] for one in (network, *loops)].count(True)
    late = {
        role: max(one["lateness_us"][role]["p99"] for one in loops) * 1e-3
        for role in WITH_DEADLINES
    }
    loop_memory = {role: mib for role, mib in found.memory_mib.items() if role in LOOP_ROLES}
    growth = max(mib[-1] - mib[len(mib) // 2] for mib in loop_memory.values())
    datagrams = network["network"]["datagrams"]
    rows = [
        Row("missing samples", sum(one["missing_samples"] for one in loops), "", goal=nothing),
        Row("unintended losses", sum(one["unintended_losses"] for one in loops), "", goal=nothing),
        Row("longest loss burst", max(one["longest_loss_burst"] for one in loops), "",
            goal=Goal("<=", CAP)),
        Row("updates", datagrams / load_.horizon_s, "/s"),
        *(
            Row(f"{role} lateness p99, worst loop", late_ms, "ms", goal=Goal("<", period_ms))
            for role, late_ms in late.items()
        ),
        *(
            Row(f"{role} lateness p99, worst loop, while no CPU time is stolen", late_ms, "ms",
                goal=Goal("<", period_ms), note=f"{found.quiet_s} s of the run")
            for role, late_ms in found.quiet_p99_ms.items()
            if found.quiet_s
        ),
        Row("loops and network not replayed bit for bit", 1 + len(loops) - unequal, "",
            goal=nothing),
        Row("CPU time per loop and step", load_.step_us(found), "µs", Peer("one loop", single_us),
            note=", ".join(f"{role} {used_s:.1f} s" for role, used_s in found.cpu_s.items())),
        Row("growth of memory in the second half, worst process", growth, "MiB",
            goal=Goal("<", _FLAT_MIB),
            note=", ".join(
                f"{role} {mib[len(mib) // 2]:.0f}–{mib[-1]:.0f}"
                for role, mib in found.memory_mib.items()
            )),
        Row("end of the run", found.end_s, "s", goal=Goal("<", load_.horizon_s)),
    ]  # fmt: skip
    name = f"{load_.loops:,} loops at {load_.rate_hz:g} Hz, {load_.horizon_s:g} s"
    return [replace(row, name=f"{name}: {row.name}") for row in rows]


def batch() -> Row:
    """Return how many runs of a loop in virtual time are computed a second."""
    loops, horizon_s = _BATCH
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "fleet.toml"
        path.write_text(scenario_of(Load(loops, 50.0, horizon_s)))
        scenario = load(path)
    begun_s = time.process_time()
    simulate_loops(scenario)
    name = f"virtual time, runs of {horizon_s:g} s of {loops} loops at 50 Hz: loops × runs"
    return Row(name, loops / (time.process_time() - begun_s), "/s of CPU")


def options(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument("--fleet-s", type=float, default=60.0, help="length of the runs, seconds")
    parser.add_argument("--fleet-loops", type=int, default=1000, help="loops at 50 Hz")
    parser.add_argument("--fleet-dir", type=Path, help="where the runs are kept meanwhile")


def measure(options: argparse.Namespace) -> list[Row]:
    """Measure both loads, and one loop at the rates of both."""
    rows = [batch()]
    for load_ in (
        Load(options.fleet_loops, 50.0, options.fleet_s),
        Load(20, 500.0, options.fleet_s),
    ):
        single = load_._replace(loops=1, horizon_s=min(load_.horizon_s, _SINGLE_S))
        measured = []
        for one in (single, load_):
            say(f"{one.loops:,} loops at {one.rate_hz:g} Hz, {one.horizon_s:g} s")
            with tempfile.TemporaryDirectory(dir=options.fleet_dir) as folder:
                measured.append(run(one, Path(folder)))
        rows += figures(load_, measured[1], single.step_us(measured[0]))
    return rows


BENCHMARK = Benchmark("fleet", "Many loops on one network", measure, options)
