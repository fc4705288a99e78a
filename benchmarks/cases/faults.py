"""Live runs with a fault: a process that dies or stops, a flood."""

import argparse
import json
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import psutil

from benchmarks.flood_sender import Flood
from benchmarks.programs import imported_s, processes_of, udp_port
from benchmarks.report import Figures, MeasurementError, Peer, Rounds, Row, benchmark, median, say
from cosim.analysis.summary.loop_statistics import lateness_us
from cosim.analysis.summary.run_summary import summarise
from cosim.cli import find_scenario
from cosim.live.finalize import finalize
from cosim.live.launcher import launch
from cosim.live.monitoring.run_watcher import Watcher
from cosim.live.processes.child_processes import MODULES
from cosim.record.run_record import RunRecord, load_record
from noack.core.errors import ExitStatus
from noack.core.linear_systems import Vector
from noack.protocol.machine_interface import GENERATION
from noack.protocol.record_tables import CONTROLLER_DELIVERY, CONTROLLER_STEP, PLANT_STEP, SENSOR_MEASUREMENT
from noack.protocol.topology import LOOP_ROLES
from noack.runtime.control_messages import RunProgress
from noack.scenario.scenario_file import load

STEPS = {"plant": PLANT_STEP, "sensor": SENSOR_MEASUREMENT, "controller": CONTROLLER_STEP}
"""Table of each process's steps."""
_QUIET_S = 0.25
"""A process has recovered if no step was late for this time."""
FAULT_S = 2.5
"""Time in the run when a fault begins."""

Outcome = TypeVar("Outcome")
Processes = Mapping[str, psutil.Process]


class FaultedRun(NamedTuple, Generic[Outcome]):
    """A run with a fault that has completed."""

    record: RunRecord
    summary: Mapping[str, Any]
    epoch_s: float
    """Time 0 of the run on the monotonic clock."""
    outcome: Outcome
    """What the fault returned."""
    back_s: float | None
    """Time in the run at which the launcher reported the process as restarted."""


def faulted_run(
    name: str, settings: Sequence[str], fault: Callable[[Processes], Outcome]
) -> FaultedRun[Outcome]:
    """Run the lane example at speed 1, with a fault.

    Args:
        name: for messages.
        settings: changes to the scenario.
        fault: called in a thread, with the processes of the run by role.
    """
    scenario = load(find_scenario("lane_following"), ["ports={}", *settings])
    threads: list[threading.Thread] = []
    outcomes, backs_s = list[Outcome](), list[float]()

    def progress(report: RunProgress) -> None:
        if report.t_s >= FAULT_S and not threads:
            processes = processes_of(psutil.Process())
            threads.append(threading.Thread(target=lambda: outcomes.append(fault(processes))))
            threads[0].start()

    watcher = Watcher(progress=progress, restarted=lambda _, t_s: backs_s.append(t_s))
    with tempfile.TemporaryDirectory(prefix="noack-bench-") as runs:
        begun_s = time.monotonic()
        ending = launch(scenario, Path(runs), watcher=watcher)
        for thread in threads:
            thread.join()
        if ending.status != ExitStatus.OK or ending.startup_s is None or not outcomes:
            raise MeasurementError(f"{name}: the run ended: {ending.reason}")
        finalize(ending, report=False, view=False)
        record = load_record(ending.run_dir)
        summary = summarise(record, ending.status, ending.reason).to_json()
    back_s = backs_s[0] if backs_s else None
    return FaultedRun(record, summary, begun_s + ending.startup_s, outcomes[0], back_s)


def recovery_s(late_at_s: Vector, end_s: float) -> float:
    """Return the time from a fault's end to the end of the sequence of late steps that follows it.

    Args:
        late_at_s: times of the late steps, ascending, (k,).
        end_s: end of the fault.
    """
    last_s = end_s
    for at_s in late_at_s[late_at_s > end_s].tolist():
        if at_s > last_s + _QUIET_S:
            break
        last_s = at_s
    return last_s - end_s


def run_recovery_s(record: RunRecord, end_s: float) -> float:
    """Return the longest :func:`recovery_s` of all processes; late: by more than a period."""
    period_us = record.scenario.timing.plant_period_ns * 1e-3
    return max(
        recovery_s(record[table]["now_ns"][lateness_us(record, role) > period_us] * 1e-9, end_s)
        for role, table in STEPS.items()
    )


ROUNDS = 3
STOPPED_S = 0.7
_RESTARTS = ("horizon_s=9", "recovery.rejoin_within_s=30")
IMPORT = "Python that imports as much"


def faulted(role: str, fault: Callable[[psutil.Process], object]) -> tuple[FaultedRun[float], float]:
    """Run with a fault of a process; return the run, and the fault's end in time of the run."""
    say(f"{role}: {fault.__name__}")

    def act(processes: Processes) -> float:
        fault(processes[role])
        return time.monotonic()

    run = faulted_run(role, _RESTARTS, act)
    return run, run.outcome - run.epoch_s


def stop(process: psutil.Process) -> None:
    """Stop a process, and continue it after 0.7 s."""
    process.send_signal(signal.SIGSTOP)
    time.sleep(STOPPED_S)
    process.send_signal(signal.SIGCONT)


def killed(role: str) -> Figures:
    """Kill a process of the loop.

    Returns:
        ``acted_s``: wall time until the restarted process acted; ``updated_s``: until the
        controller had an update again; ``unwritten_ms``: age of the last recorded row of the
        killed process at its death.
    """
    run, at_s = faulted(role, psutil.Process.kill)
    before, after = run.record.lives(role)
    if before.last_ns is None or after.first_ns is None:
        raise MeasurementError(f"{role}: has no rows before or after")
    acted_s, wrote_s = after.first_ns * 1e-9, before.last_ns * 1e-9
    deliveries = run.record[CONTROLLER_DELIVERY]
    fresh = deliveries["now_ns"] * 1e-9 >= acted_s
    if role == "sensor":
        fresh &= deliveries["sequence"] >= GENERATION
    if not fresh.any():
        raise MeasurementError(f"{role}: no update was delivered afterwards")
    updated_s = float(deliveries["now_ns"][fresh][0]) * 1e-9
    return {
        "acted_s": acted_s - at_s,
        "updated_s": updated_s - at_s,
        "unwritten_ms": 1e3 * (at_s - wrote_s),
    }


def killed_rows(role: str) -> Iterator[Row]:
    """Kill a process several times; yield the rows."""
    rounds, imported = Rounds(), partial(imported_s, MODULES[role])
    sides = {role: lambda: killed(role), IMPORT: lambda: dict.fromkeys(("acted_s", "updated_s"), imported())}
    rounds.in_turn(ROUNDS, sides, f"{role} killed, ")
    row = partial(rounds.row, ours=role)
    yield row(f"{role} killed: until another acts in its place", "s", "acted_s", peer=IMPORT)
    yield row(f"{role} killed: until the controller has an update again", "s", "updated_s", peer=IMPORT)
    note = "rows are handed over every 50 ms"
    yield row(f"{role} killed: age of its last recorded row", "ms", "unwritten_ms", note=note)


@benchmark("recovery", "A run whose processes die or stop")
def recovery(options: argparse.Namespace) -> Iterator[Row]:
    """Kill and stop each process, several times, and measure the time until the run has recovered.

    A process is killed in the middle of a run of the paper's example, and the launcher restarts it
    (``recovery.rejoin_within_s``); or it is stopped for 0.7 s and continued. The alternative is a
    Python that only imports the same modules as that process: no restart can be faster.
    """
    for role in ("sensor", "controller", "netem"):
        yield from killed_rows(role)
    run, at_s = faulted("recorder", psutil.Process.kill)
    steps = run.record[PLANT_STEP]["sequence"]
    if run.back_s is None or len(steps) != steps[-1] + 1:
        raise MeasurementError("recorder: it was not restarted, or rows are missing")
    peer, note = Peer(IMPORT, imported_s(MODULES["recorder"])), "nothing is missing from the record"
    yield Row("recorder killed: until another records", run.back_s - at_s, "s", peer, note=note)
    for role in ("plant", "sensor", "netem", "controller", "recorder"):
        runs = [faulted(role, stop) for _ in range(ROUNDS)]
        late_ms = median(1e3 * run_recovery_s(run.record, end_s) for run, end_s in runs)
        yield Row(f"{role} stopped for {STOPPED_S:g} s: last late step", late_ms, "ms")


FLOOD_S = 2.0
MARGIN_S = 0.1
"""Omitted at both ends of a flood: its time in the run is known to this accuracy."""
LOOP_HZ = 500.0


class Case(NamedTuple):
    """A flood."""

    name: str
    roles: Sequence[str]
    rate_hz: float
    """Total rate of datagrams; 0: as fast as possible."""
    asked: bool = True
    """Whether the run requests real-time settings."""


CASES = (
    Case("5 x the loop's rate", LOOP_ROLES, 5 * LOOP_HZ * len(LOOP_ROLES)),
    *(Case(f"limit, {role}", (role,), 0) for role in LOOP_ROLES),
    Case("limit, all", LOOP_ROLES, 0),
    Case("limit, all, no real-time", LOOP_ROLES, 0, asked=False),
)
_FIGURES = {
    "the flood": "datagrams/s",
    "measurements missed": "",
    "the loop's datagrams lost": "",
    "lateness before, p99": "µs",
    "lateness during, p99": "µs",
    "last late step after the end": "ms",
}
"""The figures of a flood with their units."""


def figures_of(run: FaultedRun[Flood]) -> Figures:
    """Return the effects of a flood on a run.

    Measurements missed did not reach the sensor. Lost are all datagrams of the loop that were lost
    outside the emulator. Lateness is that of the process with the largest value.
    """
    record, flood = run.record, run.outcome
    begin_s, end_s = flood.begun_s - run.epoch_s, flood.ended_s - run.epoch_s
    before, during = [], []
    for role, table in STEPS.items():
        late_us, now_s = lateness_us(record, role), record[table]["now_ns"] * 1e-9
        inside = (now_s > begin_s + MARGIN_S) & (now_s < end_s - MARGIN_S)
        before.append(np.quantile(late_us[now_s < begin_s - MARGIN_S], 0.99))
        during.append(np.quantile(late_us[inside], 0.99) if inside.any() else np.inf)
    sent = record[PLANT_STEP]["sequence"] // record.scenario.plant.measure_every
    missed = np.setdiff1d(sent, record[SENSOR_MEASUREMENT]["sequence"]).size
    values = (
        flood.rate_hz,
        missed,
        run.summary["unintended_losses"],
        float(max(before)),
        float(max(during)),
        1e3 * run_recovery_s(record, end_s),
    )
    return dict(zip(_FIGURES, values, strict=True))


@benchmark("flood", "A run under floods")
def floods(options: argparse.Namespace) -> Iterator[Row]:
    """Flood runs at speed 1, whose processes have a kernel socket for each peer.

    In the middle of a run of the paper's example, another process sends datagrams of another run to
    one port or to all: at five times the loop's rate, and as fast as possible.
    """
    for case in CASES:
        say(case.name)

        def flood(processes: Processes, case: Case = case) -> Flood:
            ports = [udp_port(processes[role]) for role in case.roles]
            program = [sys.executable, "-m", "benchmarks.flood_sender"]
            program += map(str, (FLOOD_S, case.rate_hz, *ports))
            done = subprocess.run(program, stdout=subprocess.PIPE, text=True, check=True)
            return Flood(**json.loads(done.stdout))

        settings = ["horizon_s=8", f"realtime.enabled={str(case.asked).lower()}"]
        for name, value in figures_of(faulted_run(case.name, settings, flood)).items():
            yield Row(f"{case.name}: {name}", value, _FIGURES[name])
