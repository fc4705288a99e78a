"""Latency of a live run, and lateness of a loop, beside bare programs."""

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.programs import PRIORITY, compile_program, execute, noack, program_path
from benchmarks.report import Figures, Goal, MeasurementError, Rounds, Row, benchmark, quantiles_us

ROUNDS = 3
OURS, PING = "noack", "ping and relay in C"
P99_GOAL = Goal("<=", 2)
_FREQUENT_EVENTS = ("--set", "trigger.beta=1e-9")
_RARE_EVENTS = ("--set", 'trigger={policy="periodic", period_s=0.5}')
_LOSSLESS = ("--set", 'network.loss={model="lossless"}')


class LatencyCase(NamedTuple):
    """Runs whose events have a period, and their settings."""

    period_s: float
    round_s: float
    arguments: tuple[str, ...]
    realtime: bool
    """Whether the real-time settings are requested."""
    goal: Goal
    """Of the median's ratio to that of the ping in C."""


CASES = {
    "every 2 ms, real-time settings": LatencyCase(0.002, 5.0, _FREQUENT_EVENTS, True, Goal("<=", 1.4)),
    "every 2 ms, no settings": LatencyCase(
        0.002, 5.0, (*_FREQUENT_EVENTS, "--set", "realtime.enabled=false"), False, Goal("<=", 1.3)
    ),
    "every 0.5 s, real-time settings": LatencyCase(0.5, 30.0, _RARE_EVENTS, True, Goal("<=", 1.3)),
}


def ping(program: Callable[[], Path], case: LatencyCase, refusals: set[str]) -> Figures:
    """Send datagrams through the bare relay; return one-way latencies, µs, and their count.

    Real-time settings that were not permitted are added to ``refusals``.
    """
    count, priority = round(case.round_s / case.period_s), PRIORITY if case.realtime else 0
    command = [str(program()), str(count), str(round(case.period_s * 1e9)), str(priority)]
    try:
        done = subprocess.run(command, capture_output=True, timeout=case.round_s + 30, check=True)
        latencies_ns = np.frombuffer(done.stdout, "<i8")
        figures = quantiles_us(latencies_ns)
    except (subprocess.SubprocessError, IndexError):
        raise MeasurementError("the ping through the bare relay did not end") from None
    refusals |= {line.partition(":")[0] for line in done.stderr.decode().splitlines()}
    return {**figures, "count": len(latencies_ns)}


def updates(case: LatencyCase, refusals: set[str]) -> Figures:
    """Run the loop live; return the latencies of its updates, µs, and their count."""
    horizon = ("--set", f"horizon_s={case.round_s}")
    (loop,) = noack("run", "lane_following", *horizon, *_LOSSLESS, *case.arguments).summary["loops"]
    latency = loop["latency_us"]
    for answers in loop["realtime"].values():
        refusals |= {setting for setting, answer in answers.items() if answer.startswith("not permitted")}
    return {"p50": latency["p50"], "p99": latency["p99"], "count": latency["updates"]}


@benchmark("latency", "One-way latency")
def latency(options: argparse.Namespace) -> Iterator[Row]:
    """Measure the time from the sensor's event to the controller's update, through netem.

    Compared with a bare ping through a bare relay in C, at the same period and with the same
    real-time settings. noack's figure is that of the record of a live run; it also includes the
    sensor's trigger test, tagging and checking the datagram, the loss model, the MANSD cap and the
    record, on a machine that also runs the plant, the control plane and the recorder. Events come
    with every measurement, so that all code is in the processor's caches, or every half second.
    """
    with tempfile.TemporaryDirectory(prefix="noack-bench-") as folder:
        program = cache(lambda: compile_program("ping.c", Path(folder)))
        for name, case in CASES.items():
            rounds, refusals = Rounds(), set[str]()
            pinged, run = partial(ping, program, case, refusals), partial(updates, case, refusals)
            rounds.measure_in_turn(ROUNDS, {PING: pinged, OURS: run}, f"{name}, ")
            counts = (sum(rounds.values(side, "count")) for side in (OURS, PING))
            note = "{:.0f} updates, {:.0f} pings".format(*counts)
            note += f"; not applied: {', '.join(sorted(refusals))}" if refusals else ""
            row = partial(rounds.row, unit="µs", ours=OURS, peer=PING)
            yield row(f"event → update, {name}, p50", quantity="p50", goal=case.goal, note=note)
            yield row(f"event → update, {name}, p99", quantity="p99", goal=P99_GOAL)


TICK_ROUNDS, ROUND_S = 9, 1
PERIOD_US = 1000
LOOP, KERNEL = "loop of a run", "cyclictest"
_HISTOGRAM_US = 20_000


def cyclictest(seconds: int = ROUND_S, priority: int = PRIORITY, core: int | None = None) -> Figures:
    """Return the lateness in a round of cyclictest, p50, p99 and max in µs.

    Args:
        seconds: length of the round.
        priority: SCHED_FIFO priority.
        core: its core; None: any core.
    """
    program = program_path("cyclictest", "rt-tests")
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "cyclictest.json"
        command = [
            program, "-m", "-q", "-p", str(priority), "-i", str(PERIOD_US),
            "-D", str(seconds), "-h", str(_HISTOGRAM_US), f"--json={output}",
            *(() if core is None else ("-a", str(core))),
        ]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0 or not output.is_file():
            messages = (done.stderr.strip() or done.stdout.strip() or "nothing").splitlines()[0]
            raise MeasurementError(f"cyclictest failed: {messages!r}")
        thread = json.loads(output.read_text())["thread"]["0"]
    histogram = thread["histogram"]
    late_ns = np.repeat([1000 * int(low_us) + 500 for low_us in histogram], [*histogram.values()])
    return {**quantiles_us(late_ns), "max": float(thread["max"])}


def wake_ups() -> Figures:
    """Return the lateness of a round of a run's loop with real-time settings, µs."""
    numbers = map(str, (1000 * PERIOD_US, ROUND_S, PRIORITY, 0))
    lateness = json.loads(execute([sys.executable, "-m", "cosim.doctor.probe", "wake", *numbers]).stdout)
    if (answer := lateness["settings"]["sched_fifo"]) != "applied":
        raise MeasurementError(f"SCHED_FIFO {answer}")
    return quantiles_us(lateness["realtime"])


@benchmark("lateness", "Lateness of a 1 kHz loop")
def lateness(options: argparse.Namespace) -> Iterator[Row]:
    """Run our 1 kHz loop, as ``noack doctor`` does, and cyclictest in turn.

    cyclictest (Debian: rt-tests) is the kernel's own measure: a C loop on ``clock_nanosleep`` with
    SCHED_FIFO, locked memory and no deep idle states, the settings that our processes request.
    """
    rounds = Rounds()
    rounds.measure_in_turn(TICK_ROUNDS, {KERNEL: cyclictest, LOOP: wake_ups})
    row = partial(rounds.row, unit="µs", ours=LOOP, peer=KERNEL)
    yield row("tick lateness p50", quantity="p50")
    yield row("tick lateness p99", quantity="p99", goal=Goal("<=", 1.5))
    note = f"median of {TICK_ROUNDS} rounds of {ROUND_S} s; the peer's is the machine's own"
    yield row("tick lateness max", quantity="max", note=note)
