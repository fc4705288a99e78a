"""Live runs of the lane example at speed 1 with a fault: a process that stops, a flood."""

import itertools
import os
import signal
import socket
import struct
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from statistics import median
from typing import NamedTuple

import numpy as np
import psutil

from benchmarks.report import MeasurementError, Row, announce, benchmark
from cosim.analysis.summary.loop_statistics import lateness_us
from cosim.analysis.summary.summary_model import LoopSummary
from cosim.cli.options import find_scenario
from cosim.live.finalize import finalize
from cosim.live.launcher import launch
from cosim.record.run_record import RunRecord, load_record
from noack.core.errors import ExitStatus
from noack.core.linear_systems import Vector
from noack.protocol.record_tables import CONTROLLER_DELIVERY, CONTROLLER_STEP, PLANT_STEP, SENSOR_MEASUREMENT
from noack.protocol.roles import LOOP_ROLES, ROLES
from noack.protocol.wire_format import KEY_BYTES, Encoder, Flow, Message
from noack.runtime.address import LOOPBACK
from noack.scenario.scenario_file import load
from tests.helpers.live_runs import processes_of, udp_port
from tests.helpers.waiting import wait_for

STEPS = {"plant": PLANT_STEP, "sensor": SENSOR_MEASUREMENT, "controller": CONTROLLER_STEP}
"""Table of each process's steps."""
_QUIET_S = 0.25
"""A process has recovered if no step was late for this time."""
FAULT_S = 2.5
"""Time from the start of a run to a fault."""

Fault = Callable[[Mapping[str, psutil.Process]], object]
"""Makes a fault, with the processes of a run by role; called in a thread."""


class FaultedRun(NamedTuple):
    """A run with a fault that has completed; the fault's begin and end are times of the run."""

    record: RunRecord
    summary: LoopSummary
    began_s: float
    ended_s: float


def faulted_run(name: str, settings: Sequence[str], fault: Fault) -> FaultedRun:
    """Run the lane example with changed settings and a fault."""
    announce(name)
    scenario = load(find_scenario("lane_following"), ["ports={}", *settings])
    processes = dict[str, psutil.Process]()

    def all_have_started() -> bool:
        processes.update(processes_of(psutil.Process()))
        return processes.keys() == set(ROLES)

    def make_fault() -> tuple[float, float]:
        """Return when it began, and when it ended."""
        wait_for(all_have_started)
        time.sleep(FAULT_S)
        began_s = time.monotonic()
        fault(processes)
        return began_s, time.monotonic()

    with tempfile.TemporaryDirectory(prefix="noack-bench-") as runs, ThreadPoolExecutor(1) as pool:
        launched_s = time.monotonic()
        making = pool.submit(make_fault)
        ending = launch(scenario, Path(runs))
        began_s, ended_s = (at_s - launched_s - (ending.startup_s or 0.0) for at_s in making.result())
        if ending.status != ExitStatus.OK:
            raise MeasurementError(f"{name}: the run ended: {ending.reason}")
        (summary,) = finalize(ending, report=False, view=False).summary.loops
        record = load_record(ending.run_dir)
        for table in (*STEPS.values(), CONTROLLER_DELIVERY):
            record[table]  # kept in memory: the folder is removed
    return FaultedRun(record, summary, began_s, ended_s)


def recovery_s(late_at_s: Vector, end_s: float) -> float:
    """Return the time from a fault's end to the end of the late steps that follow it without a pause.

    ``late_at_s`` are the times of all late steps, ascending.
    """
    last_s = end_s
    for at_s in late_at_s[late_at_s > end_s].tolist():
        if at_s > last_s + _QUIET_S:
            break
        last_s = at_s
    return last_s - end_s


def run_recovery_ms(run: FaultedRun) -> float:
    """Return the longest :func:`recovery_s` of all processes; late: by more than a period."""
    record = run.record
    period_us = record.scenario.timing.plant_period_ns * 1e-3
    return 1e3 * max(
        recovery_s(record[table]["now_ns"][lateness_us(record, role) > period_us] * 1e-9, run.ended_s)
        for role, table in STEPS.items()
    )


ROUNDS = 3
STOPPED_S = 0.7


def stopped_late_ms(role: str) -> float:
    """Stop a process of a run for 0.7 s; return the longest :func:`recovery_s` of all processes."""

    def fault(processes: Mapping[str, psutil.Process]) -> None:
        processes[role].send_signal(signal.SIGSTOP)
        time.sleep(STOPPED_S)
        processes[role].send_signal(signal.SIGCONT)

    return run_recovery_ms(faulted_run(f"{role} stopped", ["horizon_s=9"], fault))


@benchmark("recovery", "A run whose processes stop for a while")
def recovery() -> Iterator[Row]:
    """Stop each process, several times, and measure the time until the run has recovered."""
    for role in ("plant", "sensor", "netem", "controller", "recorder"):
        late_ms = median(stopped_late_ms(role) for _ in range(ROUNDS))
        yield Row(f"{role} stopped for {STOPPED_S:g} s: last late step", late_ms, "ms")


FLOOD_S = 2.0
MARGIN_S = 0.1
"""Omitted at both ends of a flood: its time in the run is known to this accuracy."""
_FIVEFOLD_HZ = 5 * 500.0 * len(LOOP_ROLES)
_SEGMENTS, _LONGEST_SLEEP_S = 64, 0.01
"""Datagrams of one call in a flood without a rate; pause of a slow one."""
_UDP_SEGMENT = 103


def flood(ports: Sequence[int], rate_hz: float) -> int:
    """Send state updates of another run to ports in turn; return their number.

    At a rate of 0 they are sent as fast as possible, up to 64 with one call (UDP_SEGMENT).
    """
    encoder = Encoder(int.from_bytes(os.urandom(8), "little"), os.urandom(KEY_BYTES))
    data = encoder.encode(Message(Flow.UPDATE, 0, 0, np.zeros(4)))
    count = 1 if rate_hz else _SEGMENTS
    control = [(socket.IPPROTO_UDP, _UDP_SEGMENT, struct.pack("=H", len(data)))] if count > 1 else []
    sent, began_s = 0, time.monotonic()
    with socket.socket(type=socket.SOCK_DGRAM) as sender:
        for port in itertools.cycle(ports):
            sender.sendmsg([data * count], control, 0, (LOOPBACK, port))
            sent += count
            while (passed_s := time.monotonic() - began_s) < FLOOD_S and sent > rate_hz * passed_s > 0:
                time.sleep(min(_LONGEST_SLEEP_S, 1 / rate_hz))
            if passed_s >= FLOOD_S:
                break
    return sent


def flood_rows(name: str, roles: Sequence[str], rate_hz: float, realtime: str) -> Iterator[Row]:
    """Yield the effects of a flood on a run.

    Measurements missed did not reach the sensor. Lost are all datagrams of the loop that were lost
    outside the emulator. Lateness is that of the process with the largest value.
    """
    sent = 0

    def fault(processes: Mapping[str, psutil.Process]) -> None:
        nonlocal sent
        sent = flood([udp_port(processes[role]) for role in roles], rate_hz)

    run = faulted_run(name, ["horizon_s=8", f"realtime.enabled={realtime}"], fault)
    before_us, during_us = [], []
    for role, table in STEPS.items():
        late_us, now_s = lateness_us(run.record, role), run.record[table]["now_ns"] * 1e-9
        inside = (now_s > run.began_s + MARGIN_S) & (now_s < run.ended_s - MARGIN_S)
        before_us.append(float(np.quantile(late_us[now_s < run.began_s - MARGIN_S], 0.99)))
        during_us.append(float(np.quantile(late_us[inside], 0.99)) if inside.any() else np.inf)
    measured = run.record[PLANT_STEP]["sequence"] // run.record.scenario.plant.measure_every
    missed_measurements = np.setdiff1d(measured, run.record[SENSOR_MEASUREMENT]["sequence"]).size
    yield Row(f"{name}: the flood", sent / (run.ended_s - run.began_s), "datagrams/s")
    yield Row(f"{name}: measurements missed", missed_measurements, "")
    yield Row(f"{name}: the loop's datagrams lost", run.summary.unintended_losses, "")
    yield Row(f"{name}: lateness before, p99", max(before_us), "µs")
    yield Row(f"{name}: lateness during, p99", max(during_us), "µs")
    yield Row(f"{name}: last late step after the end", run_recovery_ms(run), "ms")


@benchmark("flood", "A run under floods")
def floods() -> Iterator[Row]:
    """Flood one port of a run or all: at five times the loop's rate, and as fast as possible."""
    yield from flood_rows("5 x the loop's rate", LOOP_ROLES, _FIVEFOLD_HZ, "true")
    for role in LOOP_ROLES:
        yield from flood_rows(f"limit, {role}", (role,), 0, "true")
    yield from flood_rows("limit, all", LOOP_ROLES, 0, "true")
    yield from flood_rows("limit, all, no real-time", LOOP_ROLES, 0, "false")
