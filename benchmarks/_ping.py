"""A bare UDP ping through a bare relay: the one-way latency of plain Python without noack.

Three minimal processes: a sender that sleeps until each datagram is due, a relay with two sockets,
and a receiver. Relay and receiver block in ``recv``; the receiver reads the clock right after it. A
datagram shorter than a ping ends the next process.
"""

import argparse
import contextlib
import json
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from benchmarks._report import MeasurementError
from noack.runtime.real_time_settings import realtime

PING_BYTES = 80
"""Size of a state update with four states."""
FIFO_PRIORITY = 50
PLACES = {"sender": 1, "relay": 2, "receiver": 3}
"""Positions of sensor, emulator and controller along the loop."""
_STAMP = struct.Struct("<q")
_END = b"end"
_SETTLE_S = 0.3


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
        MeasurementError: a process failed.
    """
    flag = ("--realtime",) if asked else ()
    with _process("receiver", *flag) as receiver, contextlib.ExitStack() as stack:
        relay = stack.enter_context(_process("relay", "--to", _said(receiver), *flag))
        sender = stack.enter_context(
            _process(
                "sender", "--to", _said(relay), "--count", str(count), "--period", str(period_s),
                *flag,
            )
        )  # fmt: skip
        try:
            sender.wait(timeout=count * period_s + 30)
            found = json.loads(_said(receiver))
        except (subprocess.TimeoutExpired, ValueError, IndexError):
            raise MeasurementError("the ping through the bare relay did not end") from None
    latencies_ns, granted = found["latencies_ns"], found["granted"]
    p50_us, p99_us = (float(quantile) / 1e3 for quantile in np.quantile(latencies_ns, [0.5, 0.99]))
    return Ping(p50_us, p99_us, len(latencies_ns), granted)


@contextlib.contextmanager
def _process(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "benchmarks._ping", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        except BaseException:
            process.kill()
            raise


def _said(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


def _receive(endpoint: socket.socket, granted: dict[str, str]) -> None:
    latencies_ns = []
    while len(data := endpoint.recv(2048)) == PING_BYTES:
        now_ns = time.monotonic_ns()
        latencies_ns.append(now_ns - _STAMP.unpack_from(data)[0])
    print(json.dumps({"latencies_ns": latencies_ns, "granted": granted}), flush=True)


def _relay(endpoint: socket.socket, out: socket.socket) -> None:
    while True:
        data = endpoint.recv(2048)
        out.send(data)
        if len(data) != PING_BYTES:
            return


def _send(out: socket.socket, count: int, period_s: float) -> None:
    padding = bytes(PING_BYTES - _STAMP.size)
    begin_s = time.monotonic() + _SETTLE_S
    for number in range(count):
        time.sleep(max(begin_s + number * period_s - time.monotonic(), 0.0))
        out.send(_STAMP.pack(time.monotonic_ns()) + padding)
    time.sleep(_SETTLE_S)
    out.send(_END)


def main() -> None:
    """Run one of the three processes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("role", choices=["receiver", "relay", "sender"])
    parser.add_argument("--to", type=int, default=0, help="port of the next process")
    parser.add_argument("--count", type=int, default=0)
    parser.add_argument("--period", type=float, default=0.002)
    parser.add_argument("--realtime", action="store_true")
    options = parser.parse_args()
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as endpoint,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out,
        realtime(options.realtime, FIFO_PRIORITY, PLACES[options.role]) as granted,
    ):
        endpoint.bind(("127.0.0.1", 0))
        if options.to:
            out.connect(("127.0.0.1", options.to))
        if options.role != "sender":
            print(endpoint.getsockname()[1], flush=True)
        if options.role == "receiver":
            _receive(endpoint, granted)
        elif options.role == "relay":
            _relay(endpoint, out)
        else:
            _send(out, options.count, options.period)


if __name__ == "__main__":
    main()
