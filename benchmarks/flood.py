"""What a flood does to a run at speed 1: with the shield, and without it.

From another process, in the middle of a run of the paper's example, datagrams of another run come
to one port or to all: at five times the loop's rate, and as many as go. Without the shield what
comes from the peer and what comes from elsewhere share a queue, as on systems that have none.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import psutil

from benchmarks._flood import Flood
from benchmarks._report import Benchmark, MeasurementError, Peer, Row, median, run, say
from cosim.analysis.run_summary import summarise
from cosim.analysis.timing_statistics import lateness_us
from cosim.cli import find_scenario
from cosim.live.launcher import Watcher, launch
from cosim.record.run_record import RunRecord, load_record
from noack.config.scenario_file import load
from noack.core.errors import ExitStatus
from noack.core.linear_systems import Vector
from noack.protocol.record_tables import CONTROLLER_STEP, PLANT_STEP, SENSOR_MEASUREMENT
from noack.protocol.topology import LOOP_ROLES

ROUNDS = 1
HORIZON_S = 8.0
BEGIN_S = 2.5
FLOOD_S = 2.0
MARGIN_S = 0.1
"""At both ends of a flood: so well is it known when it was in the run's time."""
LOOP_HZ = 500.0
_QUIET_S = 0.25
"""A run is back to normal when no step was late for so long."""
_MODULES = {
    "plant": "plant_server", "sensor": "sensor_node", "netem": "netem",
    "controller": "controller_node",
}  # fmt: skip
_STEPS = {"plant": PLANT_STEP, "sensor": SENSOR_MEASUREMENT, "controller": CONTROLLER_STEP}
_UNSHIELDED = Path(__file__).parent / "_unshielded"


class Case(NamedTuple):
    """A flood."""

    name: str
    roles: Sequence[str]
    rate_hz: float | None
    """Datagrams a second in all; None is as many as go."""
    asked: bool = True
    """Whether the run asks for real-time settings."""


CASES = (
    Case("5 x the loop's rate", LOOP_ROLES, 5 * LOOP_HZ * len(LOOP_ROLES)),
    *(Case(f"limit, {role}", (role,), None) for role in LOOP_ROLES),
    Case("limit, all", LOOP_ROLES, None),
    Case("limit, all, no real-time", LOOP_ROLES, None, asked=False),
)


class Measured(NamedTuple):
    """What a flood did to a run."""

    rate_hz: float
    """Of the flood, datagrams a second."""
    missed: float
    """Measurements that the sensor never had."""
    lost: float
    """All of the loop's datagrams that were lost, other than by the emulator's decision."""
    late_before_us: float
    """Lateness before the flood, p99, of whichever process is latest."""
    late_us: float
    """The same during the flood."""
    back_ms: float
    """From the flood's end to the last step that was late by more than a period."""


def measured(record: RunRecord, lost: int, flood: Flood, epoch_s: float) -> Measured:
    """Read off a run's record what a flood did to it.

    Args:
        record: the run's, at speed 1.
        lost: datagrams of the loop that were lost outside the emulator.
        flood: what was sent, on the monotonic clock.
        epoch_s: the run's beginning on the same clock.
    """
    begin_s, end_s = flood.begun_s - epoch_s, flood.ended_s - epoch_s
    before, during, back_s = [], [], 0.0
    for role, table in _STEPS.items():
        late_us, now_s = lateness_us(record, role), record[table]["now_ns"] * 1e-9
        inside = (now_s > begin_s + MARGIN_S) & (now_s < end_s - MARGIN_S)
        before.append(np.quantile(late_us[now_s < begin_s - MARGIN_S], 0.99))
        during.append(np.quantile(late_us[inside], 0.99) if inside.any() else np.inf)
        back_s = max(back_s, recovery_s(now_s[late_us > 1e6 / LOOP_HZ], end_s))
    every = record.scenario.plant.measure_every
    sent = record[PLANT_STEP]["sequence"] // every
    missed = np.setdiff1d(sent, record[SENSOR_MEASUREMENT]["sequence"]).size
    return Measured(
        flood.rate_hz, float(missed), float(lost), float(max(before)), float(max(during)),
        1e3 * back_s,
    )  # fmt: skip


def recovery_s(late_at_s: Vector, end_s: float) -> float:
    """Time from a flood's end to the last step that was late and followed soon on the one before.

    Args:
        late_at_s: when steps were late, ascending, (k,).
        end_s: when the flood ended.
    """
    last_s = end_s
    for at_s in late_at_s[late_at_s > end_s].tolist():
        if at_s > last_s + _QUIET_S:
            break
        last_s = at_s
    return last_s - end_s


def flooded(case: Case, *, shielded: bool) -> Measured:
    """Flood a run.

    Raises:
        MeasurementError: the run failed.
    """
    settings = [f"horizon_s={HORIZON_S}", "ports={}"]
    settings += [] if case.asked else ["realtime.enabled=false"]
    scenario = load(find_scenario("lane_following"), settings)
    begun: list[subprocess.Popen[str]] = []

    def progress(account: Mapping[str, Any]) -> None:
        if account["t_s"] >= BEGIN_S and not begun:
            begun.append(_begin(case))

    with tempfile.TemporaryDirectory(prefix="noack-bench-") as runs, _environment(shielded):
        begun_s = time.monotonic()
        try:
            ending = launch(scenario, Path(runs), watcher=Watcher(progress=progress))
            output = begun[0].communicate(timeout=FLOOD_S + 10)[0] if begun else ""
        finally:
            for process in begun:
                process.kill()
        if ending.status != ExitStatus.OK or ending.startup_s is None or not output:
            raise MeasurementError(f"{case.name}: the run ended: {ending.reason}")
        record = load_record(ending.run_dir)
        summary = summarise(record, ending.status, ending.reason).to_json()
    shields = {report["channel"]["shielded"] for report in record.reports.values()}
    if shields != {shielded}:
        raise MeasurementError(f"{case.name}: shielded {shields}, expected {shielded}")
    flood = Flood(**json.loads(output))
    return measured(record, summary["unintended_losses"], flood, begun_s + ending.startup_s)


@contextmanager
def _environment(shielded: bool) -> Iterator[None]:
    before = os.environ.get("PYTHONPATH")
    if not shielded:
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(_UNSHIELDED), before]))
    try:
        yield
    finally:
        os.environ.pop("PYTHONPATH", None)
        if before is not None:
            os.environ["PYTHONPATH"] = before


def _begin(case: Case) -> "subprocess.Popen[str]":
    children = psutil.Process().children()
    ports = []
    for role in case.roles:
        (child,) = (child for child in children if _MODULES[role] in child.cmdline())
        ports += sorted({c.laddr.port for c in child.net_connections("udp4") if not c.raddr})
    rate = [] if case.rate_hz is None else ["--rate", str(case.rate_hz)]
    command = [
        sys.executable, "-m", "benchmarks._flood", "--ports", *map(str, ports),
        "--seconds", str(FLOOD_S), *rate,
    ]  # fmt: skip
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def rows_of(case: Case, ours: Sequence[Measured], peers: Sequence[Measured]) -> list[Row]:
    """Return a case's rows: medians over rounds with the shield, beside those without."""

    def row(figure: str, unit: str, of: Callable[[Measured], float]) -> Row:
        without = Peer("without the shield", median(map(of, peers)))
        return Row(f"{case.name}: {figure}", median(map(of, ours)), unit, without)

    return [
        row("the flood", "datagrams/s", lambda m: m.rate_hz),
        row("measurements missed", "", lambda m: m.missed),
        row("the loop's datagrams lost", "", lambda m: m.lost),
        row("lateness before, p99", "µs", lambda m: m.late_before_us),
        row("lateness during, p99", "µs", lambda m: m.late_us),
        row("last late step after the end", "ms", lambda m: m.back_ms),
    ]


def measure(options: argparse.Namespace) -> list[Row]:
    """Flood a run in every way, with and without the shield in turn."""
    rows = []
    for case in CASES:
        say(case.name)
        sides = [
            [flooded(case, shielded=shielded) for shielded in (True, False)] for _ in range(ROUNDS)
        ]
        ours, peers = zip(*sides, strict=True)
        rows += rows_of(case, ours, peers)
    return rows


BENCHMARK = Benchmark("flood", "A run under floods", measure)

if __name__ == "__main__":
    sys.exit(run([BENCHMARK]))
