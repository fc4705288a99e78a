"""The loop across two hosts, compared with the same processes on loopback.

The hosts are two network namespaces with a veth link. Plant, sensor and network are on the first
host, the controller is on the second. Both sides are runs by hand, without losses, in which every
measurement is an event.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from benchmarks._report import Benchmark, Goal, MeasurementError, Rounds, Row, say
from benchmarks._runs import FREE_PORTS
from benchmarks._two_hosts import TwoHosts, two_hosts

ROUNDS = 3
ACROSS, LOOPBACK = "noack across a veth link", "noack on loopback"
_PATIENCE_S = 120.0
_SETTINGS = (
    *FREE_PORTS, "--set", "horizon_s=10", "--set", "trigger.beta=1e-9",
    "--set", 'network.loss={model="lossless"}', "--no-report",
)  # fmt: skip
_AT_HOME, _AWAY = ("plant", "sensor", "netem"), ("controller",)


def run_by_hand(hosts: TwoHosts | None) -> dict[str, Any]:
    """Return the summary of a run with the controller on the second host, or all on this one.

    Raises:
        MeasurementError: a process failed.
    """
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)

        def start(host: int, *arguments: str) -> subprocess.Popen[str]:
            command = [sys.executable, "-m", "cosim.cli", *arguments]
            if hosts is not None:
                command = hosts.inside(host, *command)
            process = subprocess.Popen(
                command, cwd=folder, env=os.environ | {"XDG_RUNTIME_DIR": name}, text=True,
                stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            )  # fmt: skip
            stack.enter_context(process)
            stack.callback(process.kill)
            return process

        listen = () if hosts is None else ("--listen", hosts.addresses[0][0])
        invited = () if hosts is None else ("--invitation", "invitation.json")
        recording = start(0, "record", "lane_following", "--json", *listen, *_SETTINGS)
        joining = [start(0, role) for role in _AT_HOME]
        joining += [start(1, role, *invited) for role in _AWAY]
        stdout, stderr = recording.communicate(timeout=_PATIENCE_S)
        for process in joining:
            stderr += process.communicate(timeout=_PATIENCE_S)[1]
        if any(process.returncode for process in (recording, *joining)):
            raise MeasurementError(stderr.strip().splitlines()[-1])
        summary: dict[str, Any] = json.loads(stdout)
        return summary


def measure(_: argparse.Namespace) -> list[Row]:
    """Measure both sides in turn."""
    rounds = Rounds()
    with two_hosts() as hosts:
        for number in range(ROUNDS):
            say(f"round {number + 1} of {ROUNDS}")
            for side, place in ((LOOPBACK, None), (ACROSS, hosts)):
                found = run_by_hand(place)["latency_us"]
                rounds.add(side, {key: found[key] for key in ("p50", "p99", "updates")})
    updates = sum(rounds.of(ACROSS, "updates"))
    return [
        rounds.row(
            f"event → update, {quantile}", "µs", quantile, ACROSS, LOOPBACK, Goal("<=", 1.5),
            note=f"{updates:.0f} updates", paired=True,
        )
        for quantile in ("p50", "p99")
    ]  # fmt: skip


BENCHMARK = Benchmark("hosts", "The loop across two hosts", measure)
