"""A bare UDP ping through a bare relay, in C: the one-way latency of the kernel without noack.

Three minimal processes (``ping.c``): a sender that sleeps until each datagram is due, a relay with
two sockets, and a receiver. Relay and receiver block in ``recv``; the receiver reads the clock
right after it.
"""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks._report import MeasurementError
from noack.runtime.real_time_settings import realtime

FIFO_PRIORITY = 50
PLACES = {"sender": 1, "relay": 2, "receiver": 3}
"""Positions of sensor, emulator and controller along the loop."""


class Ping(NamedTuple):
    """One-way latencies of a ping session, µs."""

    p50_us: float
    p99_us: float
    received: int
    granted: dict[str, str]


def ping(count: int, period_s: float, *, asked: bool) -> Ping:
    """Send ``count`` datagrams, one every ``period_s``, through the relay.

    Args:
        count: number of datagrams.
        period_s: wall time between two datagrams.
        asked: whether the processes request real-time settings.

    Raises:
        MeasurementError: there is no C compiler, or a process failed.
    """
    _program()
    with ExitStack() as stack:
        receiver = stack.enter_context(_process(asked, "receiver"))
        relay = stack.enter_context(_process(asked, "relay", _line(receiver)))
        period_ns = str(round(period_s * 1e9))
        sender = stack.enter_context(_process(asked, "sender", _line(relay), str(count), period_ns))
        try:
            sender.wait(timeout=count * period_s + 30)
            *latencies_ns, granted = receiver.communicate(timeout=30)[0].splitlines()
            found = np.array(latencies_ns, np.int64) / 1e3
            p50_us, p99_us = np.quantile(found, [0.5, 0.99]).tolist()
        except (subprocess.TimeoutExpired, ValueError, IndexError):
            raise MeasurementError("the ping through the bare relay did not end") from None
    return Ping(p50_us, p99_us, len(latencies_ns), json.loads(granted))


@cache
def _program() -> Path:
    """Compile the program; return its path."""
    compiler = shutil.which("cc")
    if compiler is None:
        raise MeasurementError("the ping is written in C and cc is not installed")
    source = Path(__file__).with_name("ping.c")
    program = Path(tempfile.mkdtemp(prefix="noack-bench-")) / "ping"
    subprocess.run([compiler, "-O2", "-o", str(program), str(source)], check=True)
    return program


@contextmanager
def _process(asked: bool, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    flag = ("--realtime",) if asked else ()
    command = [sys.executable, "-m", "benchmarks._ping", *flag, str(_program()), *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        except BaseException:
            process.kill()
            raise


def _line(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


def main() -> None:
    """Run the program with real-time settings, which it inherits; print them after its output."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--realtime", action="store_true")
    parser.add_argument("command", nargs="+")
    options = parser.parse_args()
    command = [*options.command, *(["realtime"] if options.realtime else [])]
    with realtime(options.realtime, FIFO_PRIORITY, PLACES[options.command[1]]) as granted:
        subprocess.run(command, check=True)
    print(json.dumps(granted), flush=True)


if __name__ == "__main__":
    main()
