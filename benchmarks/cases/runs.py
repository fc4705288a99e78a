"""Live runs as a user starts them: start, many loops, the demo; the installation."""

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any, NamedTuple

import psutil

from benchmarks.machine_load import own_cpu_s
from benchmarks.programs import (
    NOACK,
    PRIORITY,
    ObservedRun,
    Sample,
    compile_program,
    execute,
    imported_s,
    noack,
    observed_run,
)
from benchmarks.report import (
    ZERO,
    Figures,
    Goal,
    MeasurementError,
    Peer,
    Rounds,
    Row,
    announce,
    benchmark,
    compare,
    median,
    option,
)
from noack.protocol.roles import LOOP_ROLES, WITH_DEADLINES

ROOT = Path(__file__).parents[2]
CAP = 2
_SCENARIO = Path(__file__).parents[1] / "many_loops.toml"
_KIBI = 1024
_POLL_S = 2.0
_SINGLE_S = 60.0
_MEMORY_MIB, _END_SHARE = Goal("<=", 80), Goal("<=", 0.1)
_STEP_US = {50.0: Goal("<=", 5)}
"""By the rate of the loops, Hz. Not of 20 loops at 500 Hz, of which a step is due every 100 µs:
steps that share a wake-up would be later than :data:`_LATE_MS`."""
_LATE_MS = {50.0: Goal("<=", 1.0), 500.0: Goal("<=", 0.3)}
"""By the rate of the loops, Hz."""
_BARE_S, _MOST_COALESCING_S, _MOST_BURST = 5.0, 0.0008, 64
"""Length of a bare exchange; how long a run coalesces steps, at most; datagrams in one message."""
_LIBRARIES = "import numpy, zenoh; print(); input()"


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
        return [str(_SCENARIO), *(word for setting in settings for word in ("--set", setting))]


def run(load: LoopLoad, folder: Path) -> ObservedRun:
    """Run the loops as a user does."""
    observed = observed_run(load.arguments, folder, load.horizon_s, _POLL_S)
    if (ending := observed.summary["exit"])["status"]:
        raise MeasurementError(f"{load}: {ending['reason']}")
    return observed


def cpu_share(samples: Sequence[Sample]) -> float:
    """Return CPU time per wall time."""
    first, last = samples[0], samples[-1]
    return (last.cpu_s - first.cpu_s) / (last.at_s - first.at_s)


def cpu_s(command: Sequence[str]) -> float:
    """Return the CPU seconds of a program, which other load changes less than its duration."""
    before_s = own_cpu_s(children=True)
    execute(command)
    return own_cpu_s(children=True) - before_s


def bare_step_us(load: LoopLoad) -> float:
    """Return the CPU time in µs that a step takes in C processes that only send and receive.

    A step is a measurement and an actuation. One process sends, and one receives, as many datagrams
    of 72 bytes at once as a run's processes gather.
    """
    steps_per_s = load.loops * load.rate_hz
    steps = round(steps_per_s * min(1 / load.rate_hz / 25, _MOST_COALESCING_S))
    burst = min(max(steps, 1), _MOST_BURST)
    count = round(_BARE_S * steps_per_s / burst)
    with tempfile.TemporaryDirectory() as folder:
        program = compile_program("ping.c", Path(folder))
        arguments = map(str, (count, round(1e9 * burst / steps_per_s), PRIORITY, burst))
        return 2e6 * cpu_s([str(program), *arguments]) / (count * burst)


def figures(load: LoopLoad, run: ObservedRun, bare_us: float) -> Iterator[Row]:
    """Yield the figures of a run; ``bare_us`` is a step of the bare exchange."""

    def row(name: str, value: float, unit: str = "", **more: Any) -> Row:
        return Row(f"{load}: {name}", value, unit, **more)

    network, loops = run.summary["network"], run.summary["loops"]
    samples = {role: run.in_loops(role) for role in LOOP_ROLES}
    for key in ("missing_samples", "unintended_losses"):
        yield row(key.replace("_", " "), sum(loop[key] for loop in loops), goal=ZERO)
    burst = max(loop["longest_loss_burst"] for loop in loops)
    yield row("longest loss burst", burst, goal=Goal("<=", CAP))
    yield row("updates", network["datagrams"] / load.horizon_s, "/s")
    for role in WITH_DEADLINES:
        late_ms = max(loop["lateness_us"][role]["p99"] for loop in loops) / 1e3
        yield row(f"{role} lateness p99, worst loop", late_ms, "ms", goal=_LATE_MS[load.rate_hz])
    different = sum(not loop["replay"]["bit_exact"] for loop in (network, *loops))
    yield row("loops and network not replayed bit for bit", different, goal=ZERO)
    used_us = {role: 1e6 * cpu_share(samples[role]) / (load.loops * load.rate_hz) for role in samples}
    note = ", ".join(f"{role} {used:.2f} µs" for role, used in used_us.items())
    step_us = sum(used_us.values())
    yield row("CPU time per loop and step", step_us, "µs", goal=_STEP_US.get(load.rate_hz), note=note)
    yield row("the same", step_us, "µs", peer=Peer("bare C exchange of its datagrams", bare_us))
    end_s, peer = run.closed_s - run.ended_s, Peer("the run", load.horizon_s)
    yield row("end of the run", end_s, "s", peer=peer, goal=_END_SHARE)


def memory(load: LoopLoad, run: ObservedRun) -> Iterator[Row]:
    """Yield the private memory of the processes of one loop: the median over its run."""
    used = {role: median(sample.uss_kib for sample in run.in_loops(role)) / _KIBI for role in LOOP_ROLES}
    name, total = f"{load}: private memory of {', '.join(used)}", sum(used.values())
    note = ", ".join(f"{role} {mib:.0f}" for role, mib in used.items())
    peer = Peer("as many Pythons that import numpy and zenoh", libraries_mib(len(used)))
    yield Row(name, total, "MiB", goal=_MEMORY_MIB, note=note)
    yield Row("the same", total, "MiB", peer)


def libraries_mib(count: int) -> float:
    """Return the private memory of ``count`` simultaneous Pythons that import the libraries."""
    command, pipe = [sys.executable, "-c", _LIBRARIES], subprocess.PIPE
    with ExitStack() as stack:
        pythons = [
            stack.enter_context(subprocess.Popen(command, stdin=pipe, stdout=pipe)) for _ in range(count)
        ]
        for python in pythons:
            assert python.stdout is not None
            python.stdout.readline()
        used = [psutil.Process(python.pid).memory_full_info().uss for python in pythons]
        for python in pythons:
            python.kill()
    return float(sum(used)) / _KIBI**2


@benchmark(
    "many_loops",
    "Many loops on one network",
    {
        "--many-loops-s": option(60.0, "length of the runs, seconds"),
        "--many-loops": option(1000, "loops at 50 Hz"),
    },
)
def many_loops(options: argparse.Namespace) -> Iterator[Row]:
    """Measure many loops through one bottleneck, live, and the memory of one loop.

    Each loop samples, computes and applies its input at the same rate. A step is one of the plant
    of one loop: with it come a measurement, a tick of the controller and an actuation. The CPU time
    is that of plant, sensor, emulator and controller while the loops run. The memory is that of one
    loop, beside as many Pythons that import the libraries of each process.
    """

    def measured(load: LoopLoad) -> ObservedRun:
        announce(str(load))
        with tempfile.TemporaryDirectory(prefix="noack-bench-") as folder:
            return run(load, Path(folder))

    for loops, rate_hz in ((options.many_loops, 50.0), (20, 500.0)):
        load = LoopLoad(loops, rate_hz, options.many_loops_s)
        before_us, observed, after_us = bare_step_us(load), measured(load), bare_step_us(load)
        yield from figures(load, observed, (before_us + after_us) / 2)
    alone = LoopLoad(1, 500.0, min(options.many_loops_s, _SINGLE_S))
    yield from memory(alone, measured(alone))


ROUNDS = 1
OURS, IMPORTS = "noack", "Python that imports the libraries"
_CERTIFY = (*NOACK, "certify", "lane_following")
_IMPORT_CONTROL = (sys.executable, "-c", "import control")
_LOOPS = LoopLoad(20, 500.0, 5.0)


def started() -> Figures:
    """Start a short run.

    Returns:
        ``first_s``, wall seconds from the start of ``noack run`` to the first control step, and
        ``launch_s``, the launch time from the run's summary.
    """
    started_run = noack("run", "lane_following", "--set", "horizon_s=1")
    if started_run.first_step_s is None:
        raise MeasurementError("the run showed no progress line")
    return {"first_s": started_run.first_step_s, "launch_s": started_run.summary["startup_s"]}


def demo_rows(summary: Mapping[str, Any]) -> Iterator[Row]:
    """Yield the rows of a demo run from its summary."""
    (loop,) = summary["loops"]
    late = loop["lateness_us"]["plant"]
    in_time = 100 * (1 - late["late_steps"] / late["steps"])
    yield Row("demo: missing samples", loop["missing_samples"], "samples", goal=ZERO)
    yield Row("demo: unintended losses", loop["unintended_losses"], "datagrams", goal=ZERO)
    yield Row("demo: plant steps within one period", in_time, "%", goal=Goal(">=", 99.9))
    for name in ("p50", "p99", "max"):
        yield Row(f"demo: plant lateness, {name}", late[name], "µs")


@benchmark("startup", "Time to the first control step; the demo")
def startup(options: argparse.Namespace) -> Iterator[Row]:
    """Start several short runs, and the alternatives in turn; then 20 loops, and the demo.

    The progress lines give an upper bound of the time to the first control step
    (:func:`benchmarks.programs.first_step_s`). The alternative is a Python that only imports the
    libraries that every process of a run needs. That of ``noack certify`` is one that only imports
    python-control, with which such loops are analysed. Of the demo, missing samples, unintended
    losses and late steps count: a plant step is late if it is made more than one period after its
    time.
    """
    rounds = Rounds()
    libraries = "numpy, scipy.linalg, pydantic, zenoh"
    rounds.measure_in_turn(ROUNDS, {OURS: started, IMPORTS: lambda: {"first_s": imported_s(libraries)}})
    note = "upper bound: includes a progress line's way through the recorder"
    yield rounds.row("noack run → first control step", "s", "first_s", OURS, goal=Goal("<=", 0.6), note=note)
    yield rounds.row("the same, against a bare import", "s", "first_s", OURS, IMPORTS)
    yield rounds.row("of it, from launch to time 0, by its summary", "s", "launch_s", OURS)
    yield compare(
        "noack certify lane_following, with all limits",
        "CPU s",
        lambda: cpu_s(_CERTIFY),
        ("Python that imports python-control", lambda: cpu_s(_IMPORT_CONTROL)),
        Goal("<", 1),
    )
    announce("20 loops")
    with tempfile.TemporaryDirectory(prefix="noack-bench-") as folder:
        began_s = time.monotonic()
        run(_LOOPS, Path(folder))
        loops_s = time.monotonic() - began_s
    yield Row("the first run of 20 loops, 5 s, without report", loops_s, "s", goal=Goal("<=", 15))
    announce("noack demo, 20 s")
    yield from demo_rows(noack("demo").summary)


PROGRAM = ("noack", "netem", "cosim", "plant_server", "sensor_node", "controller_node")


def installed_bytes(names: Iterable[str]) -> int:
    """Return the bytes of the files of installed distributions."""
    total = 0
    for name in names:
        try:
            files = distribution(name).files or ()
        except PackageNotFoundError:  # only on other systems or versions of Python
            continue
        total += sum(path.stat().st_size for file in files if (path := Path(file.locate())).is_file())
    return total


def lines(*patterns: str) -> int:
    """Return the number of lines of the files in the repository."""
    command = ["git", "ls-files", "-z", "--", *patterns]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    files = [ROOT / name for name in listed.split("\0") if name]
    return sum(len(file.read_bytes().splitlines()) for file in files if file.is_file())


@benchmark("size", "Installation and code")
def size(options: argparse.Namespace) -> Iterator[Row]:
    """Count the bytes of the installation, and the lines of code."""
    lock = (ROOT / "requirements.lock").read_text()
    default = set(re.findall(r"^([A-Za-z0-9_.-]+)==", lock, re.M))
    python = lines(*(f"{folder}/*.py" for folder in PROGRAM))
    yield Row("installed without extras", installed_bytes(default) / 1e6, "MB")
    yield Row(
        "of it, numba and llvmlite",
        installed_bytes(default & {"numba", "llvmlite"}) / 1e6,
        "MB",
        goal=ZERO,
    )
    yield Row("Python outside tests and benchmarks", python, "lines")
    yield Row("Python outside tests", python + lines("benchmarks/*.py"), "lines", goal=Goal("<=", 64_000))
    yield Row("C", lines("native/*.c", "native/*.h"), "lines", goal=Goal("<=", 5_000))


@benchmark("clone", "The demo from a clean clone")
def clone(options: argparse.Namespace) -> Iterator[Row]:
    """Clone the last commit, install, and run the demo to its verdict; 20 s of it are the run."""
    with tempfile.TemporaryDirectory(prefix="noack-bench-") as folder:
        announce("make demo from a clean clone")
        subprocess.run(["git", "clone", "-q", str(ROOT), folder], check=True)
        began_s = time.monotonic()
        execute(["env", "--unset=VIRTUAL_ENV", "make", "-C", folder, "demo"])
        spent_s = time.monotonic() - began_s
    compiler = "gcc present" if shutil.which("cc") else "no C compiler"
    yield Row(f"make demo from a clean clone to its verdict, {compiler}", spent_s, "s", goal=Goal("<=", 60))
