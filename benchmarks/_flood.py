"""A flood: a separate process sends unwanted datagrams, at a given rate or as fast as possible.

``python -m benchmarks._flood --ports 47001 47002 --seconds 3`` prints as JSON the times of start
and end on the monotonic clock, and the number of datagrams. They are state updates of another run,
sent from several ports in turn. On Linux one call sends up to 64 datagrams to a port (UDP_SEGMENT).
"""

import argparse
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
SEGMENTS = 64 if sys.platform == "linux" else 1
"""Maximum number of datagrams of one call."""
_SENDERS = 4
_UDP_SEGMENT = 103
_HEADER = struct.Struct("<2sBBHHQ")
_LONGEST_SLEEP_S = 0.01


class Flood(NamedTuple):
    """Result of a flood."""

    begun_s: float
    ended_s: float
    sent: int

    @property
    def rate_hz(self) -> float:
        """Datagrams per second."""
        return self.sent / (self.ended_s - self.begun_s)


def datagram() -> bytes:
    """A state update of four entries, of another run."""
    size = datagram_bytes(4)
    header = _HEADER.pack(b"NA", 1, Flow.UPDATE, 4, 0, int.from_bytes(os.urandom(8), "little"))
    return header + os.urandom(size - len(header))


def flood(ports: Sequence[int], seconds: float, rate_hz: float | None) -> Flood:
    """Send to ports in turn.

    Args:
        ports: destination ports.
        seconds: duration.
        rate_hz: total rate of datagrams; None: as fast as possible.
    """
    data, sent = datagram(), 0
    count = SEGMENTS if rate_hz is None else 1
    control = [(socket.IPPROTO_UDP, _UDP_SEGMENT, struct.pack("=H", len(data)))]
    with ExitStack() as stack:
        endpoints = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(_SENDERS)]
        senders = itertools.cycle([stack.enter_context(endpoint) for endpoint in endpoints])
        targets = itertools.cycle([(LOOPBACK, port) for port in ports])
        begun_s = time.monotonic()
        while (passed_s := time.monotonic() - begun_s) < seconds:
            if rate_hz is not None and sent >= rate_hz * passed_s:
                time.sleep(min(_LONGEST_SLEEP_S, 1 / rate_hz))
                continue
            next(senders).sendmsg([data * count], control if count > 1 else [], 0, next(targets))
            sent += count
        return Flood(begun_s, time.monotonic(), sent)


def main() -> None:
    """Run the flood and print the result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ports", type=int, nargs="+", required=True)
    parser.add_argument("--seconds", type=float, required=True)
    parser.add_argument("--rate", type=float, help="datagrams a second in all; else as many as go")
    options = parser.parse_args()
    print(json.dumps(flood(options.ports, options.seconds, options.rate)._asdict()))


if __name__ == "__main__":
    main()
