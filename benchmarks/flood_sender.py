"""Sends unwanted datagrams: ``python -m benchmarks.flood_sender SECONDS RATE PORT...``.

They are state updates of another run, sent from several ports in turn at a total rate, or as fast
as possible (rate 0). On Linux one call sends up to 64 datagrams to a port (UDP_SEGMENT). It prints a
:class:`Flood` as JSON.
"""

import itertools
import json
import os
import socket
import struct
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from typing import NamedTuple

from noack.protocol.wire_format import Flow, datagram_bytes

LOOPBACK = "127.0.0.1"


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


if __name__ == "__main__":
    seconds, rate_hz, *ports = sys.argv[1:]
    print(json.dumps(flood([*map(int, ports)], float(seconds), float(rate_hz))._asdict()))
