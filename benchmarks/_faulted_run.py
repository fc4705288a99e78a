"""A run of the lane example at speed 1 with a fault in one of its processes."""

import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import psutil

from benchmarks._report import MeasurementError
from benchmarks.soak.watch import is_of
from cosim.analysis.loop_statistics import lateness_us
from cosim.analysis.run_summary import summarise
from cosim.cli import find_scenario
from cosim.live.launcher import launch
from cosim.live.run_watcher import Watcher
from cosim.record.run_record import RunRecord, load_record
from noack.config.scenario_file import load
from noack.core.errors import ExitStatus
from noack.core.linear_systems import Vector
from noack.protocol.record_tables import CONTROLLER_STEP, PLANT_STEP, SENSOR_MEASUREMENT
from noack.protocol.topology import ROLES
from noack.runtime.control_messages import RunProgress

STEPS = {"plant": PLANT_STEP, "sensor": SENSOR_MEASUREMENT, "controller": CONTROLLER_STEP}
"""Table of each process's steps."""
_QUIET_S = 0.25
"""A process has recovered if no step was late for this time."""

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
    name: str, settings: Sequence[str], at_s: float, fault: Callable[[Processes], Outcome]
) -> FaultedRun[Outcome]:
    """Run the lane example, with a fault.

    Args:
        name: for messages.
        settings: changes to the scenario.
        at_s: time in the run when the fault begins.
        fault: called in a thread, with the processes of the run by role.

    Raises:
        MeasurementError: the run failed.
    """
    scenario = load(find_scenario("lane_following"), ["ports={}", *settings])
    threads: list[threading.Thread] = []
    outcomes, backs_s = list[Outcome](), list[float]()

    def progress(report: RunProgress) -> None:
        if report.t_s >= at_s and not threads:
            children = psutil.Process().children()
            processes = {role: child for role in ROLES for child in children if is_of(role, child)}
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
        recovery_s(
            record[table]["now_ns"][lateness_us(record, role) > period_us] * 1e-9, end_s
        )
        for role, table in STEPS.items()
    )  # fmt: skip
