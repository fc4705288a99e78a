"""Effect of a flood on a run at speed 1, whose processes have a kernel socket for each peer.

In the middle of a run of the paper's example, another process sends datagrams of another run to one
port or to all: at five times the loop's rate, and as fast as possible.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from benchmarks._faulted_run import STEPS, FaultedRun, Processes, faulted_run, run_recovery_s
from benchmarks._flood import Flood
from benchmarks._report import Benchmark, Figures, Rounds, Row, say
from benchmarks.soak.watch import udp_port
from cosim.analysis.loop_statistics import lateness_us
from noack.protocol.record_tables import PLANT_STEP, SENSOR_MEASUREMENT
from noack.protocol.topology import LOOP_ROLES

ROUNDS = 1
HORIZON_S = 8.0
BEGIN_S = 2.5
FLOOD_S = 2.0
MARGIN_S = 0.1
"""Omitted at both ends of a flood: its time in the run is known to this accuracy."""
LOOP_HZ = 500.0
OURS = "noack"


class Case(NamedTuple):
    """A flood."""

    name: str
    roles: Sequence[str]
    rate_hz: float | None
    """Total rate of datagrams; None: as fast as possible."""
    asked: bool = True
    """Whether the run requests real-time settings."""


CASES = (
    Case("5 x the loop's rate", LOOP_ROLES, 5 * LOOP_HZ * len(LOOP_ROLES)),
    *(Case(f"limit, {role}", (role,), None) for role in LOOP_ROLES),
    Case("limit, all", LOOP_ROLES, None),
    Case("limit, all, no real-time", LOOP_ROLES, None, asked=False),
)


def figures_of(run: FaultedRun[Flood]) -> Figures:
    """Return the effects of a flood on a run at speed 1.

    ``missed``: measurements that did not reach the sensor. ``lost``: all datagrams of the loop that
    were lost outside the emulator. Lateness: p99 of the process with the largest value.
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
    return {
        "rate_hz": flood.rate_hz,
        "missed": np.setdiff1d(sent, record[SENSOR_MEASUREMENT]["sequence"]).size,
        "lost": run.summary["unintended_losses"],
        "late_before_us": float(max(before)),
        "late_during_us": float(max(during)),
        "back_ms": 1e3 * run_recovery_s(record, end_s),
    }


def flooded(case: Case) -> Figures:
    """Flood a run.

    Raises:
        MeasurementError: the run failed.
    """
    settings = [f"horizon_s={HORIZON_S}"]
    settings += [] if case.asked else ["realtime.enabled=false"]
    run = faulted_run(case.name, settings, BEGIN_S, partial(_flood, case))
    return figures_of(run)


def _flood(case: Case, processes: Processes) -> Flood:
    ports = [udp_port(processes[role]) for role in case.roles]
    rate = [] if case.rate_hz is None else ["--rate", str(case.rate_hz)]
    command = [
        sys.executable, "-m", "benchmarks._flood", "--ports", *map(str, ports),
        "--seconds", str(FLOOD_S), *rate,
    ]  # fmt: skip
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return Flood(**json.loads(done.stdout))


def rows_of(case: Case, rounds: Rounds) -> list[Row]:
    """Return a case's rows."""
    figures = (
        ("the flood", "datagrams/s", "rate_hz"),
        ("measurements missed", "", "missed"),
        ("the loop's datagrams lost", "", "lost"),
        ("lateness before, p99", "µs", "late_before_us"),
        ("lateness during, p99", "µs", "late_during_us"),
        ("last late step after the end", "ms", "back_ms"),
    )
    return [
        rounds.row(f"{case.name}: {figure}", unit, quantity, OURS)
        for figure, unit, quantity in figures
    ]


def measure(options: argparse.Namespace) -> list[Row]:
    """Measure each flood."""
    rows = []
    for case in CASES:
        say(case.name)
        rounds = Rounds()
        for _ in range(ROUNDS):
            rounds.add(OURS, flooded(case))
        rows += rows_of(case, rounds)
    return rows


BENCHMARK = Benchmark("flood", "A run under floods", measure)
