"""Bare programs that run as processes of their own: ticking loops, a flood.

``python -m benchmarks.bare_programs NAME ...`` runs one of them:

* ``ticks LOOP COUNT PERIOD_NS PRIORITY``: a loop that ticks at a fixed rate, and prints p50, p99
  and maximum of the lateness, µs, and the real-time settings. Priority 0: none are requested.
* ``flood SECONDS RATE PORT...``: sends unwanted datagrams at a total rate, or as fast as possible
  (rate 0). They are state updates of another run, sent from several ports in turn. On Linux one
  call sends up to 64 datagrams to a port (UDP_SEGMENT). Prints a :class:`Flood` as JSON.
"""

import asyncio
import itertools
import json
import os
import socket
import struct
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from typing import NamedTuple

import numpy as np

from noack.core.clock import NS_PER_S
from noack.protocol.wire_format import Flow, datagram_bytes
from noack.runtime.real_time_loop import realtime

LOOPBACK = "127.0.0.1"
PRIORITY = 50


def command_of(program: str, *arguments: object) -> list[str]:
    """Return the command that runs a program."""
    return [sys.executable, "-m", "benchmarks.bare_programs", program, *map(str, arguments)]


def _run_loop(count: int, period_ns: int) -> Sequence[int]:
    from cosim.doctor.probe import idle_lateness_ns  # takes half a second: a flood begins at once

    return idle_lateness_ns(period_ns, count * period_ns / NS_PER_S)


def _asyncio(count: int, period_ns: int) -> list[int]:
    late_ns: list[int] = []
    loop = asyncio.new_event_loop()  # its clock is the monotonic clock
    begin_ns = time.monotonic_ns()

    def tick() -> None:
        late_ns.append(time.monotonic_ns() - begin_ns - (len(late_ns) + 1) * period_ns)
        if len(late_ns) == count:
            loop.stop()
        else:
            loop.call_at((begin_ns + (len(late_ns) + 1) * period_ns) * 1e-9, tick)

    loop.call_at((begin_ns + period_ns) * 1e-9, tick)
    loop.run_forever()
    loop.close()
    return late_ns


LOOPS: Mapping[str, Callable[[int, int], Sequence[int]]] = {
    "run_loop": _run_loop,
    "asyncio": _asyncio,
}


def ticks(loop: str, count: str, period_ns: str, priority: str) -> None:
    """Run one loop and print its lateness."""
    with realtime(priority != "0", max(int(priority), 1)) as granted:
        late_ns = LOOPS[loop](int(count), int(period_ns))
    p50_us, p99_us, max_us = np.quantile(late_ns, [0.5, 0.99, 1.0]) / 1e3
    print(json.dumps([{"p50": p50_us, "p99": p99_us, "max": max_us}, granted]))


class Flood(NamedTuple):
    """Result of a flood; times are of the monotonic clock."""

    begun_s: float
    ended_s: float
    sent: int

    @property
    def rate_hz(self) -> float:
        """Datagrams per second."""
        return self.sent / (self.ended_s - self.begun_s)


SEGMENTS = 64 if sys.platform == "linux" else 1
"""Maximum number of datagrams of one call."""
_SENDERS = 4
_UDP_SEGMENT = 103
_HEADER = struct.Struct("<2sBBHHQ")
_LONGEST_SLEEP_S = 0.01


def unwanted_datagram() -> bytes:
    """A state update of four entries, of another run."""
    size = datagram_bytes(4)
    header = _HEADER.pack(b"NA", 1, Flow.UPDATE, 4, 0, int.from_bytes(os.urandom(8), "little"))
    return header + os.urandom(size - len(header))


def flood(ports: Sequence[int], seconds: float, rate_hz: float) -> Flood:
    """Send to ports in turn; a rate of 0 is as fast as possible."""
    data, sent = unwanted_datagram(), 0
    count = 1 if rate_hz else SEGMENTS
    control = [(socket.IPPROTO_UDP, _UDP_SEGMENT, struct.pack("=H", len(data)))]
    with ExitStack() as stack:
        endpoints = [socket.socket(type=socket.SOCK_DGRAM) for _ in range(_SENDERS)]
        senders = itertools.cycle([stack.enter_context(endpoint) for endpoint in endpoints])
        targets = itertools.cycle([(LOOPBACK, port) for port in ports])
        begun_s = time.monotonic()
        while (passed_s := time.monotonic() - begun_s) < seconds:
            if rate_hz and sent >= rate_hz * passed_s:
                time.sleep(min(_LONGEST_SLEEP_S, 1 / rate_hz))
                continue
            next(senders).sendmsg([data * count], control if count > 1 else [], 0, next(targets))
            sent += count
        return Flood(begun_s, time.monotonic(), sent)


def print_flood(seconds: str, rate_hz: str, *ports: str) -> None:
    """Run a flood and print the result."""
    print(json.dumps(flood([*map(int, ports)], float(seconds), float(rate_hz))._asdict()))


if __name__ == "__main__":
    _, name, *arguments = sys.argv
    {"ticks": ticks, "flood": print_flood}[name](*arguments)
