"""Recovery time of a run at speed 1 after one of its processes was killed or stopped.

A process is killed in the middle of a run of the paper's example, and the launcher restarts it
(``recovery.rejoin_within_s``); or it is stopped for 0.7 s and continued. The alternative is a
Python that only imports the same modules as that process: no restart can be faster.
"""

import argparse
import signal
import sys
import time
from collections.abc import Callable
from functools import partial

import psutil

from benchmarks._faulted_run import FaultedRun, Processes, faulted_run, run_recovery_s
from benchmarks._report import Benchmark, Figures, MeasurementError, Peer, Rounds, Row, median, say
from benchmarks._runs import execute
from cosim.live.child_processes import MODULES
from noack.protocol.machine_interface import GENERATION
from noack.protocol.record_tables import CONTROLLER_DELIVERY, PLANT_STEP

ROUNDS = 3
FAULT_S, STOPPED_S = 2.5, 0.7
SETTINGS = ("horizon_s=9", "recovery.rejoin_within_s=30")
IMPORT = "Python that imports as much"


def faulted(
    role: str, fault: Callable[[psutil.Process], object]
) -> tuple[FaultedRun[float], float]:
    """Run with a fault of a process; return the run, and the fault's end in time of the run.

    Raises:
        MeasurementError: the run failed.
    """
    say(f"{role}: {fault.__name__}")

    def act(processes: Processes) -> float:
        fault(processes[role])
        return time.monotonic()

    run = faulted_run(role, SETTINGS, FAULT_S, act)
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


def imported_s(role: str) -> float:
    """Return wall seconds from the start of a Python to the end of a process's imports."""
    code = f"import {MODULES[role]}, sys; print('ready', file=sys.stderr)"
    finished = execute([sys.executable, "-c", code])
    return finished.lines[-1].at_s - finished.begun_s


def killed_rows(role: str) -> list[Row]:
    """Kill a process several times; return the rows."""
    rounds = Rounds()
    for _ in range(ROUNDS):
        rounds.add(role, killed(role))
        rounds.add(IMPORT, dict.fromkeys(("acted_s", "updated_s"), imported_s(role)))
    row = partial(rounds.row, ours=role)
    return [
        row(f"{role} killed: until another acts in its place", "s", "acted_s", peer=IMPORT),
        row(f"{role} killed: until the controller has an update again", "s", "updated_s",
            peer=IMPORT),
        row(f"{role} killed: age of its last recorded row", "ms", "unwritten_ms",
            note="rows are handed over every 50 ms"),
    ]  # fmt: skip


def recorder_row() -> Row:
    """Kill the recorder; return the row.

    Raises:
        MeasurementError: it was not restarted, or rows are missing.
    """
    run, at_s = faulted("recorder", psutil.Process.kill)
    steps = run.record[PLANT_STEP]["sequence"]
    if run.back_s is None or len(steps) != steps[-1] + 1:
        raise MeasurementError("recorder: it was not restarted, or rows are missing")
    return Row(
        "recorder killed: until another records", run.back_s - at_s, "s",
        Peer(IMPORT, imported_s("recorder")), note="nothing is missing from the record",
    )  # fmt: skip


def stopped_row(role: str) -> Row:
    """Stop a process several times; return the time from its end to the last late step of all."""
    runs = [faulted(role, stop) for _ in range(ROUNDS)]
    late_ms = median(1e3 * run_recovery_s(run.record, at_s) for run, at_s in runs)
    return Row(f"{role} stopped for {STOPPED_S:g} s: last late step", late_ms, "ms")


def measure(options: argparse.Namespace) -> list[Row]:
    """Kill and stop each process, several times."""
    return [
        *(row for role in ("sensor", "controller", "netem") for row in killed_rows(role)),
        recorder_row(),
        *map(stopped_row, ("plant", "sensor", "netem", "controller", "recorder")),
    ]


BENCHMARK = Benchmark("recovery", "A run whose processes die or stop", measure)
