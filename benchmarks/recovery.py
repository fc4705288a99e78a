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
HORIZON_S = 9.0
FAULT_S = 2.5
STOPPED_S = 0.7
IMPORT = "Python that imports as much"


def suffer(role: str, fault: Callable[[psutil.Process], float]) -> tuple[FaultedRun[float], float]:
    """Run with a fault of a process; return the run, and the fault's end in time of the run.

    Args:
        role: the process.
        fault: returns the time of its end on the monotonic clock.

    Raises:
        MeasurementError: the run failed.
    """

    def of_role(processes: Processes) -> float:
        return fault(processes[role])

    settings = [f"horizon_s={HORIZON_S}", "recovery.rejoin_within_s=30"]
    run = faulted_run(role, settings, FAULT_S, of_role)
    return run, run.outcome - run.epoch_s


def kill(process: psutil.Process) -> float:
    """Kill a process."""
    process.kill()
    return time.monotonic()


def stop(process: psutil.Process) -> float:
    """Stop a process, and continue it after 0.7 s."""
    process.send_signal(signal.SIGSTOP)
    time.sleep(STOPPED_S)
    process.send_signal(signal.SIGCONT)
    return time.monotonic()


def killed(role: str) -> Figures:
    """Kill a process of the loop.

    Returns:
        ``acted_s``: wall time until the restarted process acted; ``updated_s``: until the
        controller had an update again; ``unwritten_ms``: age of the last recorded row of the
        killed process at its death.
    """
    run, at_s = suffer(role, kill)
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


def stopped_ms(role: str) -> float:
    """Stop a process for 0.7 s; return the wall time from then to the last late step of all."""
    run, at_s = suffer(role, stop)
    return 1e3 * run_recovery_s(run.record, at_s)


def imported_s(role: str) -> float:
    """Return wall seconds from the start of a Python to the end of a process's imports."""
    module = MODULES[role]
    command = [sys.executable, "-c", f"import {module}, sys; print('ready', file=sys.stderr)"]
    finished = execute(command)
    return finished.lines[-1].at_s - finished.begun_s


def killed_rows(role: str) -> list[Row]:
    """Kill a process several times; return the rows."""
    rounds = Rounds()
    for number in range(ROUNDS):
        say(f"{role} killed, round {number + 1} of {ROUNDS}")
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
    say("recorder killed")
    run, at_s = suffer("recorder", kill)
    steps = run.record[PLANT_STEP]["sequence"]
    if run.back_s is None or len(steps) != steps[-1] + 1:
        raise MeasurementError("recorder: it was not restarted, or rows are missing")
    return Row(
        "recorder killed: until another records", run.back_s - at_s, "s",
        Peer(IMPORT, imported_s("recorder")), note="nothing is missing from the record",
    )  # fmt: skip


def measure(options: argparse.Namespace) -> list[Row]:
    """Kill and stop each process, several times."""
    rows = [row for role in ("sensor", "controller", "netem") for row in killed_rows(role)]
    rows.append(recorder_row())
    for role in ("plant", "sensor", "netem", "controller", "recorder"):
        say(f"{role} stopped")
        late_ms = median([stopped_ms(role) for _ in range(ROUNDS)])
        rows.append(Row(f"{role} stopped for {STOPPED_S:g} s: last late step", late_ms, "ms"))
    return rows


BENCHMARK = Benchmark("recovery", "A run whose processes die or stop", measure)
