"""A bare UDP ping through a bare relay: the one-way latency of C (``ping.c``) or Python alone.

Three minimal processes: a sender that sleeps until each datagram is due, a relay, and a receiver.
Relay and receiver block in ``recv``; the receiver reads the clock right after it. An empty datagram
ends the next process. Both programs have the same arguments, output and real-time settings, which
are those of a run; this module is the one in Python.
"""

import os
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from benchmarks._report import MeasurementError
from noack.runtime.real_time_loop import realtime

PING_BYTES = 72
PYTHON = (sys.executable, "-m", "benchmarks._ping")
_FIFO_PRIORITY = 50
_STAMP = struct.Struct("<q")
_SETTLE_S = 0.3


class Ping(NamedTuple):
    """One-way latencies of a ping session, µs."""

    p50_us: float
    p99_us: float
    received: int
    refused: list[str]
    """The real-time settings that were not permitted."""


def ping(command: Sequence[str], count: int, period_s: float, *, asked: bool) -> Ping:
    """Send ``count`` datagrams, one every ``period_s``, through the relay of a program.

    Args:
        command: the program: that of ``ping.c``, or ``PYTHON``.
        count: number of datagrams.
        period_s: wall time between two datagrams.
        asked: whether the processes request real-time settings.

    Raises:
        MeasurementError: the program failed.
    """
    numbers = (count, round(period_s * 1e9), _FIFO_PRIORITY if asked else 0)
    try:
        done = subprocess.run(
            [*command, *map(str, numbers)], capture_output=True, timeout=count * period_s + 30,
            check=True,
        )  # fmt: skip
        latencies_us = np.frombuffer(done.stdout, "<i8") / 1e3
        p50_us, p99_us = np.quantile(latencies_us, [0.5, 0.99]).tolist()
    except (subprocess.SubprocessError, IndexError):
        raise MeasurementError("the ping through the bare relay did not end") from None
    refused = {line.partition(":")[0] for line in done.stderr.decode().splitlines()}
    return Ping(p50_us, p99_us, len(latencies_us), sorted(refused))


def _receive(endpoint: socket.socket) -> None:
    latencies_ns = []
    while data := endpoint.recv(2048):
        now_ns = time.monotonic_ns()
        latencies_ns.append(now_ns - _STAMP.unpack_from(data)[0])
    os.write(sys.stdout.fileno(), np.array(latencies_ns, "<i8").tobytes())


def _relay(endpoint: socket.socket, out: socket.socket) -> None:
    data = b"first"
    while data:
        data = endpoint.recv(2048)
        out.send(data)


def _send(out: socket.socket, count: int, period_s: float) -> None:
    padding = bytes(PING_BYTES - _STAMP.size)
    begin_s = time.monotonic() + _SETTLE_S
    for number in range(count):
        time.sleep(max(begin_s + number * period_s - time.monotonic(), 0.0))
        out.send(_STAMP.pack(time.monotonic_ns()) + padding)
    time.sleep(_SETTLE_S)
    out.send(b"")


def main() -> None:
    """Run the three processes: ``_ping COUNT PERIOD_NS PRIORITY``."""
    count, period_ns, priority = map(int, sys.argv[1:])
    receiver, relay, relay_out, out = (socket.socket(type=socket.SOCK_DGRAM) for _ in range(4))
    for endpoint, sender in ((receiver, relay_out), (relay, out)):
        endpoint.bind(("127.0.0.1", 0))
        sender.connect(endpoint.getsockname())
    # The receiver first; a place is that of controller, emulator and sensor along the loop.
    for place in (3, 2, 1):
        if os.fork() > 0:
            continue
        with realtime(priority > 0, max(priority, 1), place) as granted:
            for setting, answer in granted.items():
                if answer.startswith("not permitted"):
                    print(f"{setting}: {answer}", file=sys.stderr, flush=True)
            if place == 3:
                _receive(receiver)
            elif place == 2:
                _relay(relay, relay_out)
            else:
                _send(out, count, period_ns * 1e-9)
        os._exit(0)
    for _ in range(3):
        _, status = os.wait()
        if status != 0:
            sys.exit(1)


if __name__ == "__main__":
    main()
