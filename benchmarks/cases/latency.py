"""Latency of a live run, and lateness of a loop, beside bare programs."""

import json
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.programs import (
    PRIORITY,
    compile_program,
    execute,
    in_new_process,
    noack,
    program_path,
    set_options,
)
from benchmarks.report import Goal, MeasurementError, Row, benchmark
from benchmarks.rounds import Figures, Rounds, quantiles_us
from cosim.doctor.probe import wake

ROUNDS = 3
OURS, PING = "noack", "ping and relay in C"
_FREQUENT_EVENTS = "trigger.beta=1e-9"
_RARE_EVENTS = 'trigger={policy="periodic", period_s=0.5}'


class LatencyCase(NamedTuple):
    """Runs whose events have a period, and their trigger."""

    period_s: float
    round_s: float
    trigger: str
    realtime: bool
    """Whether the real-time settings are requested."""
    goal: Goal
    """Of the median's ratio to that of the ping in C."""


CASES = {
    "every 2 ms, real-time settings": LatencyCase(0.002, 5.0, _FREQUENT_EVENTS, True, Goal("<=", 1.3)),
    "every 2 ms, no settings": LatencyCase(0.002, 5.0, _FREQUENT_EVENTS, False, Goal("<=", 1.2)),
    "every 0.5 s, real-time settings": LatencyCase(0.5, 30.0, _RARE_EVENTS, True, Goal("<=", 0.6)),
}


def ping(case: LatencyCase) -> Figures:
    """Send datagrams through the bare relay; return one-way latencies, µs, and their count."""
    count, period_ns = round(case.round_s / case.period_s), round(case.period_s * 1e9)
    numbers = map(str, (count, period_ns, PRIORITY if case.realtime else 0))
    latencies_ns = [int(line) for line in execute(compile_program("ping.c"), *numbers).split()]
    return {**quantiles_us(latencies_ns), "count": len(latencies_ns)}


def updates(case: LatencyCase, refusals: set[str]) -> Figures:
    """Run the loop live; return the latencies of its updates, µs, and their count."""
    realtime = f"realtime.enabled={str(case.realtime).lower()}"
    settings = (f"horizon_s={case.round_s}", 'network.loss={model="lossless"}', case.trigger, realtime)
    (loop,) = noack("run", "lane_following", *set_options(*settings))["loops"]
    latency = loop["latency_us"]
    for answers in loop["realtime"].values():
        refusals |= {setting for setting, answer in answers.items() if answer.startswith("not permitted")}
    return {"p50": latency["p50"], "p99": latency["p99"], "count": latency["updates"]}


@benchmark("latency", "One-way latency")
def latency() -> Iterator[Row]:
    """Measure the time from the sensor's event to the controller's update, through netem.

    Compared with a bare ping through a bare relay in C, at the same period and with the same
    real-time settings. Events come with every measurement, so that all code is in the processor's
    caches, or every half second.
    """
    for name, case in CASES.items():
        rounds, refusals = Rounds(), set[str]()
        sides = {PING: partial(ping, case), OURS: partial(updates, case, refusals)}
        rounds.measure_in_turn(ROUNDS, sides, f"{name}, ")
        counts = (sum(rounds.values(side, "count")) for side in (OURS, PING))
        note = "{:.0f} updates, {:.0f} pings".format(*counts)
        note += f"; not applied: {', '.join(sorted(refusals))}" if refusals else ""
        row = partial(rounds.row, unit="µs", ours=OURS, peer=PING)
        yield row(f"event → update, {name}, p50", quantity="p50", goal=case.goal, note=note)
        yield row(f"event → update, {name}, p99", quantity="p99", goal=Goal("<=", 1.5))


TICK_ROUNDS, ROUND_S = 9, 1
PERIOD_US = 1000
LOOP, KERNEL = "loop of a run", "cyclictest"
_HISTOGRAM_US = 20_000


def cyclictest(seconds: int = ROUND_S, priority: int = PRIORITY, core: int | None = None) -> Figures:
    """Return the lateness in a round of cyclictest, by default on any core, µs."""
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "cyclictest.json"
        command = [program_path("cyclictest", "rt-tests"), "-m", "-q", "-p", str(priority)]
        command += ["-i", str(PERIOD_US), "-D", str(seconds), "-h", str(_HISTOGRAM_US), f"--json={output}"]
        execute(*command, *(() if core is None else ("-a", str(core))))
        histogram = json.loads(output.read_text())["thread"]["0"]["histogram"]
    return quantiles_us(np.repeat([1000 * int(low_us) + 500 for low_us in histogram], [*histogram.values()]))


def wake_ups() -> Figures:
    """Return the lateness of a round of a run's loop with real-time settings, µs."""
    lateness: Any = in_new_process(partial(wake, is_realtime=True), 1000 * PERIOD_US, ROUND_S, PRIORITY, 0)
    if (answer := lateness["settings"]["sched_fifo"]) != "applied":
        raise MeasurementError(f"SCHED_FIFO {answer}")
    return quantiles_us(lateness["late_ns"])


@benchmark("lateness", "Lateness of a 1 kHz loop")
def lateness() -> Iterator[Row]:
    """Run our 1 kHz loop, as ``noack doctor`` does, and cyclictest, the kernel's own measure, in turn."""
    rounds = Rounds()
    rounds.measure_in_turn(TICK_ROUNDS, {KERNEL: cyclictest, LOOP: wake_ups})
    yield rounds.row("tick lateness p99", "µs", "p99", LOOP, KERNEL, Goal("<=", 1.5))
