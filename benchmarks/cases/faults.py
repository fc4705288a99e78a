"""Live runs with a fault: a process that dies or stops, a flood."""

import argparse
import itertools
import os
import signal
import socket
import struct
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import psutil

from benchmarks.programs import imported_s
from benchmarks.report import Figures, MeasurementError, Peer, Rounds, Row, announce, benchmark, median
from cosim.analysis.summary.loop_statistics import lateness_us
from cosim.analysis.summary.summary_model import LoopSummary
from cosim.cli.options import find_scenario
from cosim.live.finalize import finalize
from cosim.live.launcher import launch
from cosim.live.monitoring.run_watcher import Watcher
from cosim.live.processes.child_processes import MODULES
from cosim.record.run_record import RunRecord, load_record
from noack.core.errors import ExitStatus
from noack.core.linear_systems import Vector
from noack.protocol.record_tables import CONTROLLER_DELIVERY, CONTROLLER_STEP, PLANT_STEP, SENSOR_MEASUREMENT
from noack.protocol.roles import GENERATION, LOOP_ROLES, ROLES
from noack.protocol.wire_format import KEY_BYTES, Encoder, Flow, Message
from noack.runtime.address import LOOPBACK
from noack.runtime.control_messages import RunProgress
from noack.scenario.scenario_file import load
from tests.helpers.live_runs import processes_of, udp_port

STEPS = {"plant": PLANT_STEP, "sensor": SENSOR_MEASUREMENT, "controller": CONTROLLER_STEP}
"""Table of each process's steps."""
_QUIET_S = 0.25
"""A process has recovered if no step was late for this time."""
FAULT_S = 2.5
"""Time in the run when a fault begins."""

Fault = Callable[[Mapping[str, psutil.Process]], object]
"""Makes a fault, with the processes of a run by role."""


class FaultedRun(NamedTuple):
    """A run with a fault that has completed; its times are those of the run."""

    record: RunRecord
    summary: LoopSummary
    began_s: float
    """The fault's begin."""
    ended_s: float
    """The fault's end."""


def faulted_run(name: str, settings: Sequence[str], fault: Fault) -> FaultedRun:
    """Run the lane example at speed 1, with a fault.

    Args:
        name: for messages.
        settings: changes to the scenario.
        fault: makes the fault; called in a thread.
    """
    announce(name)
    scenario = load(find_scenario("lane_following"), ["ports={}", *settings])
    threads, fault_s = list[threading.Thread](), list[float]()

    def timed_fault(processes: Mapping[str, psutil.Process]) -> None:
        fault_s.append(time.monotonic())
        fault(processes)
        fault_s.append(time.monotonic())

    def progress(report: RunProgress) -> None:
        if report.t_s >= FAULT_S and not threads:
            processes = processes_of(psutil.Process())
            if processes.keys() == set(ROLES):  # else at the next report: a title cannot be read now
                threads.append(threading.Thread(target=timed_fault, args=(processes,)))
                threads[0].start()

    with tempfile.TemporaryDirectory(prefix="noack-bench-") as runs:
        launched_s = time.monotonic()
        ending = launch(scenario, Path(runs), watcher=Watcher(progress=progress))
        for thread in threads:
            thread.join()
        if ending.status != ExitStatus.OK or ending.startup_s is None or len(fault_s) < 2:
            raise MeasurementError(f"{name}: the run ended: {ending.reason}")
        (summary,) = finalize(ending, report=False, view=False).summary.loops
        record = load_record(ending.run_dir)
        for table in (*STEPS.values(), CONTROLLER_DELIVERY):
            record.source.whole(table)  # kept in memory: the folder is removed
    return FaultedRun(record, summary, *(at_s - launched_s - ending.startup_s for at_s in fault_s))


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
_RESTARTS = ("horizon_s=9", "recovery.rejoin_within_s=30")
IMPORT = "Python that imports as much"


def kill(role: str) -> FaultedRun:
    """Kill a process of a run, which is restarted."""
    return faulted_run(f"{role} killed", _RESTARTS, lambda processes: processes[role].kill())


def stop(role: str) -> FaultedRun:
    """Stop a process of a run, and continue it after 0.7 s."""

    def fault(processes: Mapping[str, psutil.Process]) -> None:
        processes[role].send_signal(signal.SIGSTOP)
        time.sleep(STOPPED_S)
        processes[role].send_signal(signal.SIGCONT)

    return faulted_run(f"{role} stopped", _RESTARTS, fault)


def measure_kill(role: str) -> Figures:
    """Kill a process of the loop.

    Returns:
        ``acted_s``: wall time until the restarted process acted; ``updated_s``: until the
        controller had an update again; ``unwritten_ms``: age of the last recorded row of the
        killed process at its death.
    """
    run = kill(role)
    (restart,) = run.summary.restarts
    if restart.first_s is None or restart.last_s is None:
        raise MeasurementError(f"{role}: has no rows before or after")
    deliveries = run.record[CONTROLLER_DELIVERY]
    fresh = deliveries["now_ns"] * 1e-9 >= restart.first_s
    if role == "sensor":
        fresh &= deliveries["sequence"] >= GENERATION
    if not fresh.any():
        raise MeasurementError(f"{role}: no update was delivered afterwards")
    return {
        "acted_s": restart.first_s - run.ended_s,
        "updated_s": float(deliveries["now_ns"][fresh][0]) * 1e-9 - run.ended_s,
        "unwritten_ms": 1e3 * (run.ended_s - restart.last_s),
    }


def killed_rows(role: str) -> Iterator[Row]:
    """Kill a process several times; yield the rows."""
    rounds, import_s = Rounds(), partial(imported_s, MODULES[role])
    sides = {
        role: lambda: measure_kill(role),
        IMPORT: lambda: dict.fromkeys(("acted_s", "updated_s"), import_s()),
    }
    rounds.measure_in_turn(ROUNDS, sides, f"{role} killed, ")
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
    run = kill("recorder")
    steps = run.record[PLANT_STEP]["sequence"]
    back_s = [restart.first_s for restart in run.summary.restarts if restart.first_s is not None]
    if not back_s or len(steps) != steps[-1] + 1:
        raise MeasurementError("recorder: it was not restarted, or rows are missing")
    peer, note = Peer(IMPORT, imported_s(MODULES["recorder"])), "nothing is missing from the record"
    yield Row("recorder killed: until another records", back_s[0] - run.ended_s, "s", peer, note=note)
    for role in ("plant", "sensor", "netem", "controller", "recorder"):
        late_ms = median(run_recovery_ms(stop(role)) for _ in range(ROUNDS))
        yield Row(f"{role} stopped for {STOPPED_S:g} s: last late step", late_ms, "ms")


FLOOD_S = 2.0
MARGIN_S = 0.1
"""Omitted at both ends of a flood: its time in the run is known to this accuracy."""
LOOP_HZ = 500.0
_SEGMENTS, _SENDERS, _LONGEST_SLEEP_S = 64, 4, 0.01
"""Datagrams of one call in a flood without a rate; sockets that send it; pause of a slow one."""
_UDP_SEGMENT = 103


class FloodCase(NamedTuple):
    """A flood."""

    name: str
    roles: Sequence[str]
    rate_hz: float
    """Total rate of datagrams; 0: as fast as possible."""
    realtime: bool = True
    """Whether the run requests real-time settings."""


CASES = (
    FloodCase("5 x the loop's rate", LOOP_ROLES, 5 * LOOP_HZ * len(LOOP_ROLES)),
    *(FloodCase(f"limit, {role}", (role,), 0) for role in LOOP_ROLES),
    FloodCase("limit, all", LOOP_ROLES, 0),
    FloodCase("limit, all, no real-time", LOOP_ROLES, 0, realtime=False),
)


def flood(ports: Sequence[int], rate_hz: float) -> int:
    """Send state updates of another run to ports in turn; return their number.

    They are sent from several ports in turn. At a rate of 0 they are sent as fast as possible, up
    to 64 with one call (UDP_SEGMENT).
    """
    encoder = Encoder(int.from_bytes(os.urandom(8), "little"), os.urandom(KEY_BYTES))
    data = encoder.encode(Message(Flow.UPDATE, 0, 0, np.zeros(4)))
    count = 1 if rate_hz else _SEGMENTS
    control = [(socket.IPPROTO_UDP, _UDP_SEGMENT, struct.pack("=H", len(data)))] if count > 1 else []
    targets, sent, began_s = itertools.cycle((LOOPBACK, port) for port in ports), 0, time.monotonic()
    with ExitStack() as stack:
        senders = [stack.enter_context(socket.socket(type=socket.SOCK_DGRAM)) for _ in range(_SENDERS)]
        for sender, target in zip(itertools.cycle(senders), targets, strict=False):
            sender.sendmsg([data * count], control, 0, target)
            sent += count
            while (passed_s := time.monotonic() - began_s) < FLOOD_S and sent > rate_hz * passed_s > 0:
                time.sleep(min(_LONGEST_SLEEP_S, 1 / rate_hz))
            if passed_s >= FLOOD_S:
                break
    return sent


def flood_rows(case: FloodCase) -> Iterator[Row]:
    """Yield the effects of a flood on a run.

    Measurements missed did not reach the sensor. Lost are all datagrams of the loop that were lost
    outside the emulator. Lateness is that of the process with the largest value.
    """
    sent = 0

    def fault(processes: Mapping[str, psutil.Process]) -> None:
        nonlocal sent
        sent = flood([udp_port(processes[role]) for role in case.roles], case.rate_hz)

    settings = ["horizon_s=8", f"realtime.enabled={str(case.realtime).lower()}"]
    run = faulted_run(case.name, settings, fault)
    before, during = [], []
    for role, table in STEPS.items():
        late_us, now_s = lateness_us(run.record, role), run.record[table]["now_ns"] * 1e-9
        inside = (now_s > run.began_s + MARGIN_S) & (now_s < run.ended_s - MARGIN_S)
        before.append(float(np.quantile(late_us[now_s < run.began_s - MARGIN_S], 0.99)))
        during.append(float(np.quantile(late_us[inside], 0.99)) if inside.any() else np.inf)
    measured = run.record[PLANT_STEP]["sequence"] // run.record.scenario.plant.measure_every
    missed_measurements = np.setdiff1d(measured, run.record[SENSOR_MEASUREMENT]["sequence"]).size
    yield Row(f"{case.name}: the flood", sent / (run.ended_s - run.began_s), "datagrams/s")
    yield Row(f"{case.name}: measurements missed", missed_measurements, "")
    yield Row(f"{case.name}: the loop's datagrams lost", run.summary.unintended_losses, "")
    yield Row(f"{case.name}: lateness before, p99", max(before), "µs")
    yield Row(f"{case.name}: lateness during, p99", max(during), "µs")
    yield Row(f"{case.name}: last late step after the end", run_recovery_ms(run), "ms")


@benchmark("flood", "A run under floods")
def floods(options: argparse.Namespace) -> Iterator[Row]:
    """Flood runs at speed 1, whose processes have a kernel socket for each peer.

    In the middle of a run of the paper's example, the launcher's process sends datagrams of another
    run to one port or to all: at five times the loop's rate, and as fast as possible.
    """
    for case in CASES:
        yield from flood_rows(case)
