"""How soon a run at speed 1 is itself again after one of its processes died, or stood still.

A process is killed in the middle of a run of the paper's example, and the launcher starts another
(``recovery.rejoin_within_s``); or it is stopped for 0.7 s and continued. The alternative is a
Python that does no more than import what that process imports: no restart can be faster.
"""

import argparse
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import psutil

from benchmarks._report import Benchmark, MeasurementError, Peer, Row, median, run, say
from benchmarks._runs import execute
from cosim.analysis.timing_statistics import lateness_us
from cosim.cli import find_scenario
from cosim.live.launcher import Watcher, launch
from cosim.record.run_record import RunRecord, load_record
from noack.config.scenario_file import load
from noack.core.errors import ExitStatus
from noack.protocol.machine_interface import GENERATION
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
)

ROUNDS = 3
HORIZON_S = 9.0
FAULT_S = 2.5
STILL_S = 0.7
_QUIET_S = 0.25
_MODULES = {
    "sensor": "sensor_node", "controller": "controller_node", "netem": "netem",
    "recorder": "cosim.live.recorder", "plant": "plant_server",
}  # fmt: skip
_STEPS = {"plant": PLANT_STEP, "sensor": SENSOR_MEASUREMENT, "controller": CONTROLLER_STEP}


class Fault(NamedTuple):
    """What befell a run, and what is left of it."""

    record: RunRecord
    at_s: float
    """In the run's time: when the process was killed, or continued."""
    back_s: float | None
    """When the launcher said that it is back."""


def suffer(role: str, befall: Callable[[psutil.Process], float]) -> Fault:
    """Let something befall a process of a run.

    Args:
        role: the process.
        befall: does it, and returns when it was over, on the monotonic clock.

    Raises:
        MeasurementError: the run failed.
    """
    settings = [f"horizon_s={HORIZON_S}", "ports={}", "recovery.rejoin_within_s=30"]
    scenario = load(find_scenario("lane_following"), settings)
    done: list[threading.Thread] = []
    ends_s, backs_s = list[float](), list[float]()

    def progress(account: Mapping[str, Any]) -> None:
        if account["t_s"] >= FAULT_S and not done:
            (process,) = (
                child for child in psutil.Process().children() if _MODULES[role] in child.cmdline()
            )
            done.append(threading.Thread(target=lambda: ends_s.append(befall(process))))
            done[0].start()

    watcher = Watcher(progress=progress, back=lambda _, t_s: backs_s.append(t_s))
    with tempfile.TemporaryDirectory(prefix="noack-bench-") as runs:
        begun_s = time.monotonic()
        ending = launch(scenario, Path(runs), watcher=watcher)
        for thread in done:
            thread.join()
        if ending.status != ExitStatus.OK or ending.startup_s is None or not ends_s:
            raise MeasurementError(f"{role}: the run ended: {ending.reason}")
        record = load_record(ending.run_dir)
    epoch_s = begun_s + ending.startup_s
    return Fault(record, ends_s[0] - epoch_s, backs_s[0] if backs_s else None)


def kill(process: psutil.Process) -> float:
    """Kill it."""
    process.kill()
    return time.monotonic()


def stop(process: psutil.Process) -> float:
    """Let it stand still for a while."""
    process.send_signal(signal.SIGSTOP)
    time.sleep(STILL_S)
    process.send_signal(signal.SIGCONT)
    return time.monotonic()


def killed(role: str) -> tuple[float, float, float]:
    """Kill a process of the loop.

    Returns:
        Wall seconds until another acted in its place, until the controller had an update again, and
        by how much the dead one's last row on record came before its death.
    """
    fault = suffer(role, kill)
    before, after = fault.record.lives(role)
    acted_s = np.concatenate([rows["now_ns"] for rows in after.rows.values()]).min() * 1e-9
    wrote_s = np.concatenate([rows["now_ns"] for rows in before.rows.values()]).max() * 1e-9
    deliveries = fault.record[CONTROLLER_DELIVERY]
    fresh = deliveries["now_ns"] * 1e-9 >= acted_s
    if role == "sensor":
        fresh &= deliveries["sequence"] >= GENERATION
    if not fresh.any():
        raise MeasurementError(f"{role}: no update was delivered afterwards")
    updated_s = float(deliveries["now_ns"][fresh][0]) * 1e-9
    return acted_s - fault.at_s, updated_s - fault.at_s, fault.at_s - wrote_s


def stopped(role: str) -> float:
    """Let a process stand still; return wall seconds from its end to the last late step of all."""
    fault = suffer(role, stop)
    period_us = fault.record.scenario.timing.plant_period_ns * 1e-3
    last_s = fault.at_s
    for process, table in _STEPS.items():
        now_s = fault.record[table]["now_ns"] * 1e-9
        late = (lateness_us(fault.record, process) > period_us) & (now_s > fault.at_s)
        end_s = fault.at_s
        for at_s in now_s[late].tolist():
            if at_s > end_s + _QUIET_S:
                break
            end_s = at_s
        last_s = max(last_s, end_s)
    return last_s - fault.at_s


def imported_s(role: str) -> float:
    """Wall seconds from the start of a Python until it has imported what a process imports."""
    module = _MODULES[role] + (".__main__" if role != "recorder" else "")
    command = [sys.executable, "-c", f"import {module}, sys; print('ready', file=sys.stderr)"]
    finished = execute(command)
    return finished.lines[-1].at_s - finished.begun_s


def measure(options: argparse.Namespace) -> list[Row]:
    """Kill and stop each process, several times."""
    rows: list[Row] = []
    for role in ("sensor", "controller", "netem"):
        found, imports_s = [], []
        for number in range(ROUNDS):
            say(f"{role} killed, round {number + 1} of {ROUNDS}")
            found.append(killed(role))
            imports_s.append(imported_s(role))
        rows += rows_of(role, found, imports_s)
    say("recorder killed")
    fault = suffer("recorder", kill)
    steps = fault.record[PLANT_STEP]["sequence"]
    if fault.back_s is None or len(steps) != steps[-1] + 1:
        raise MeasurementError("recorder: it did not come back, or rows are missing")
    rows.append(
        Row("recorder killed: until another records", fault.back_s - fault.at_s, "s",
            Peer("Python that imports as much", imported_s("recorder")),
            note="nothing is missing from the record")
    )  # fmt: skip
    for role in ("plant", "sensor", "netem", "controller", "recorder"):
        say(f"{role} stands still")
        late_s = median([stopped(role) for _ in range(ROUNDS)])
        name = f"{role} stood still for {STILL_S:g} s: last late step after that"
        rows.append(Row(name, 1e3 * late_s, "ms"))
    return rows


def rows_of(
    role: str, found: Sequence[tuple[float, float, float]], imports_s: Sequence[float]
) -> list[Row]:
    """Return the rows of a process that was killed, from the rounds."""
    acted_s, updated_s, unwritten_s = (median([one[i] for one in found]) for i in range(3))
    peer = Peer("Python that imports as much", median(imports_s))
    return [
        Row(f"{role} killed: until another acts in its place", acted_s, "s", peer),
        Row(f"{role} killed: until the controller has an update again", updated_s, "s", peer),
        Row(f"{role} killed: its last row on record is older by", 1e3 * unwritten_s, "ms",
            note="rows are handed over every 50 ms"),
    ]  # fmt: skip


BENCHMARK = Benchmark("recovery", "A run whose processes die or stand still", measure)

if __name__ == "__main__":
    sys.exit(run([BENCHMARK]))
