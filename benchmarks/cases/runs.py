"""Live runs as a user starts them: start, many loops, the demo."""

import json
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import psutil

from benchmarks.emulator_start import emulator_rows
from benchmarks.machine_load import own_cpu_s
from benchmarks.observed_runs import ObservedRun, observed_run
from benchmarks.programs import PRIORITY, compile_program, execute, imported_s, noack, set_options
from benchmarks.report import ZERO, Goal, MeasurementError, Peer, Row, announce, benchmark
from benchmarks.rounds import Figures, Rounds, compare
from noack.protocol.roles import LOOP_ROLES, WITH_DEADLINES
from tests.helpers.live_runs import EPHEMERAL, noack_command

CAP = 2
_SCENARIO = Path(__file__).parents[1] / "many_loops.toml"
_KIBI = 1024
_POLL_S = 2.0
_SINGLE_S = 60.0
_STEP = {50.0: Goal("<=", 1.6)}
"""By the rate of the loops, Hz. Not of 20 loops at 500 Hz, of which a step is due every 100 µs:
steps that share a wake-up would be later than :data:`_LATE_MS`."""
_LATE_MS = {50.0: Goal("<=", 1.0), 500.0: Goal("<=", 0.3)}
"""By the rate of the loops, Hz."""
_BARE_S, _MOST_COALESCING_S, _MOST_BURST = 5.0, 0.0008, 64
"""Length of a bare exchange; how long a run coalesces steps, at most; datagrams in one message."""


class LoopLoad(NamedTuple):
    """The loops of a run."""

    loops: int
    rate_hz: float
    horizon_s: float

    def __str__(self) -> str:
        plural = "s" if self.loops > 1 else ""
        return f"{self.loops:,} loop{plural} at {self.rate_hz:g} Hz, {self.horizon_s:g} s"

    @property
    def arguments(self) -> Sequence[str]:
        """Scenario and settings.

        The bottleneck carries what the guarantee demands even if every sample is an event. A slower
        one would stay congested after a stall of the computer: late updates cause events, events
        delays.
        """
        bits = 92 * 8  # an update of two states with its UDP and IP header
        rate_bps = int(self.loops * self.rate_hz * bits / (CAP + 1))
        settings = (
            f"horizon_s={self.horizon_s}",
            f"plant.rate_hz={self.rate_hz}",
            f"controller.rate_hz={self.rate_hz}",
            f'network.impairments=[{{ kind = "rate", rate_bps = {rate_bps}, queue = 1000 }}]',
            f'loops=[{{ name = "loop", count = {self.loops} }}]',
        )
        return [str(_SCENARIO), *set_options(*settings)]


def run(load: LoopLoad) -> ObservedRun:
    """Run the loops as a user does."""
    announce(str(load))
    with tempfile.TemporaryDirectory(prefix="noack-bench-") as folder:
        observed = observed_run(load.arguments, Path(folder), load.horizon_s, _POLL_S)
    if (ending := observed.summary["exit"])["status"]:
        raise MeasurementError(f"{load}: {ending['reason']}")
    return observed


def cpu_s(*command: str) -> float:
    """Return the CPU seconds of a program, which other load changes less than its duration."""
    before_s = own_cpu_s(children=True)
    execute(*command)
    return own_cpu_s(children=True) - before_s


def certify_cpu_s(*options: str) -> float:
    """Return the CPU seconds of ``noack certify lane_following``, before which nothing was found."""
    with tempfile.TemporaryDirectory(prefix="noack-bench-") as cache:
        command = noack_command("certify", "lane_following", *options)
        return cpu_s("env", f"XDG_CACHE_HOME={cache}", *command)


def bare_step_us(load: LoopLoad) -> float:
    """Return the CPU time in µs that a step takes in C processes that only send and receive.

    A step is a measurement and an actuation. One process sends, and one receives, as many datagrams
    of 72 bytes at once as a run's processes gather.
    """
    steps_per_s = load.loops * load.rate_hz
    steps = round(steps_per_s * min(1 / load.rate_hz / 25, _MOST_COALESCING_S))
    burst = min(max(steps, 1), _MOST_BURST)
    count = round(_BARE_S * steps_per_s / burst)
    arguments = map(str, (count, round(1e9 * burst / steps_per_s), PRIORITY, burst))
    return 2e6 * cpu_s(compile_program("ping.c"), *arguments) / (count * burst)


def figures(load: LoopLoad, run: ObservedRun, bare_us: float) -> Iterator[Row]:
    """Yield the figures of a run; ``bare_us`` is a step of the bare exchange."""

    def row(name: str, value: float, unit: str = "", **more: Any) -> Row:
        return Row(f"{load}: {name}", value, unit, **more)

    network, loops = run.summary["network"], run.summary["loops"]
    for key in ("missing_samples", "unintended_losses"):
        yield row(key.replace("_", " "), sum(loop[key] for loop in loops), goal=ZERO)
    burst = max(loop["longest_loss_burst"] for loop in loops)
    yield row("longest loss burst", burst, goal=Goal("<=", CAP))
    for role in WITH_DEADLINES:
        late_ms = max(loop["lateness_us"][role]["p99"] for loop in loops) / 1e3
        yield row(f"{role} lateness p99, worst loop", late_ms, "ms", goal=_LATE_MS[load.rate_hz])
    different = sum(not loop["replay"]["bit_exact"] for loop in (network, *loops))
    yield row("loops and network not replayed bit for bit", different, goal=ZERO)
    used_us = {role: 1e6 * run.cpu_share(role) / (load.loops * load.rate_hz) for role in LOOP_ROLES}
    note = ", ".join(f"{role} {used:.2f} µs" for role, used in used_us.items())
    step_us = sum(used_us.values())
    peer, goal = Peer("bare C exchange of its datagrams", bare_us), _STEP.get(load.rate_hz)
    yield row("CPU time per loop and step", step_us, "µs", peer=peer, goal=goal, note=note)
    peer = Peer("the run", load.horizon_s)
    yield row("end of the run", run.closed_s - run.ended_s, "s", peer=peer, goal=Goal("<=", 0.4))


def memory(load: LoopLoad, run: ObservedRun) -> Iterator[Row]:
    """Yield the private memory of the processes of one loop: the median over its run."""
    used = {role: median(sample.uss_kib for sample in run.in_loops(role)) / _KIBI for role in LOOP_ROLES}
    name, total = f"{load}: private memory of {', '.join(used)}", sum(used.values())
    note = ", ".join(f"{role} {mib:.0f}" for role, mib in used.items())
    peer = Peer("as many Pythons that import numpy and zenoh", libraries_mib(len(used)))
    yield Row(name, total, "MiB", peer, Goal("<=", 1.2), note)


def libraries_mib(count: int) -> float:
    """Return the private memory of ``count`` simultaneous Pythons that import the libraries."""
    command, pipe = [sys.executable, "-c", "import numpy, zenoh; print(); input()"], subprocess.PIPE
    pythons = [psutil.Popen(command, stdin=pipe, stdout=pipe) for _ in range(count)]
    for python in pythons:
        python.stdout.readline()
    used_bytes = sum(python.memory_full_info().uss for python in pythons)
    for python in pythons:
        python.communicate(b"\n")
    return float(used_bytes) / _KIBI**2


@benchmark("many_loops", "Many loops on one network")
def many_loops(loops: int = 1000, loops_s: float = 60.0) -> Iterator[Row]:
    """Measure many loops through one bottleneck, live, and the memory of one loop.

    A step is one of the plant of one loop: with it come a measurement, a tick of the controller and
    an actuation. The CPU time is that of plant, sensor, emulator and controller while the loops run.
    """
    for load in (LoopLoad(loops, 50.0, loops_s), LoopLoad(20, 500.0, loops_s)):
        before_us, observed, after_us = bare_step_us(load), run(load), bare_step_us(load)
        yield from figures(load, observed, (before_us + after_us) / 2)
    alone = LoopLoad(1, 500.0, min(loops_s, _SINGLE_S))
    yield from memory(alone, run(alone))


OURS, IMPORTS = "noack", "Python that imports the libraries"
_LOOPS = LoopLoad(20, 500.0, 5.0)
_TIMED = """
import sys, time
from cosim.cli import main
from cosim.live import launcher

launch = launcher.launch

def timed(*arguments, **options):
    print("launch", time.monotonic_ns(), file=sys.stderr)
    return launch(*arguments, **options)

launcher.launch = timed
main()
"""
"""``noack`` that also prints when it begins to launch a run."""
_LAUNCH = re.compile(r"^launch ([0-9]+)$", re.MULTILINE)


def started() -> Figures:
    """Start a short run at speed 1.

    Returns:
        ``first_s``, wall seconds from the start of ``noack run`` to the first control step, which is 1 ms
        after time 0, and ``launch_s``, of it those from the launch to time 0, by the run's summary.
    """
    words = ("run", "lane_following", "--set", "horizon_s=1", "--json", *EPHEMERAL)
    with tempfile.TemporaryDirectory() as folder:
        command = (sys.executable, "-c", _TIMED, *words, "--runs", folder)
        began_s = time.monotonic()
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        launch = _LAUNCH.search(result.stderr)
        if result.returncode or launch is None:
            raise MeasurementError("the run failed")
        launch_s = json.loads(result.stdout)["startup_s"]
        return {"first_s": int(launch[1]) * 1e-9 - began_s + launch_s + 1e-3, "launch_s": launch_s}


@benchmark("startup", "Time to the first control step; the demo")
def startup() -> Iterator[Row]:
    """Install the emulator alone; start a short run, then 20 loops, and the demo; a certificate.

    The alternative to a start is a Python that only imports the libraries that every process of a
    run needs; that of ``noack certify`` is one that only imports python-control, with which such
    loops are analysed. A plant step of the demo is late if it is made more than one period after its
    time.
    """
    yield from emulator_rows()
    rounds = Rounds()
    libraries = "numpy, scipy.linalg, pydantic, zenoh"
    rounds.measure_in_turn(1, {OURS: started, IMPORTS: lambda: {"first_s": imported_s(libraries)}})
    name, goal = "`noack run` to the first control step", Goal("<=", 2.5)
    yield rounds.row(name, "s", "first_s", OURS, IMPORTS, goal)
    yield rounds.row("of it, from launch to time 0, by its summary", "s", "launch_s", OURS)
    name = "`noack certify lane_following --no-search`"
    peer = "Python that imports python-control", lambda: cpu_s(sys.executable, "-c", "import control")
    yield compare(name, "CPU s", lambda: certify_cpu_s("--no-search"), peer, Goal("<=", 2.5))
    name, goal = "`noack certify lane_following`, search and checker", Goal("<=", 5, of_value=True)
    yield compare(name, "CPU s", certify_cpu_s, peer, goal, rounds=3)
    began_s = time.monotonic()
    run(_LOOPS)
    loops_s = time.monotonic() - began_s
    yield Row("the first run of 20 loops, 5 s, without report", loops_s, "s", goal=Goal("<=", 15))
    announce("noack demo, 20 s")
    (loop,) = noack("demo")["loops"]
    late = loop["lateness_us"]["plant"]
    in_time = 100 * (1 - late["late_steps"] / late["steps"])
    yield Row("demo: missing samples", loop["missing_samples"], "samples", goal=ZERO)
    yield Row("demo: unintended losses", loop["unintended_losses"], "datagrams", goal=ZERO)
    yield Row("demo: plant steps within one period", in_time, "%", goal=Goal(">=", 99.9))
