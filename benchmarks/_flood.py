"""A flood: a separate process sends unwanted datagrams, at a given rate or as fast as possible.

``python -m benchmarks._flood --ports 47001 47002 --seconds 3`` prints as JSON the times of start
and end on the monotonic clock, and the number of datagrams. They are state updates of another run,
sent from several ports in turn. One call sends many datagrams (sendmmsg) if the system supports it.
"""

import argparse
import ctypes
import itertools
import json
import os
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

from noack.protocol.wire_format import Flow, datagram_bytes

LOOPBACK = "127.0.0.1"
_SENDERS = 4
_AT_ONCE = 64
_HEADER = struct.Struct("<2sBBHHQ")
_CHUNK_S = 0.01

Send = Callable[[int], int]
"""Sends at most the given number of datagrams, to each port in turn; returns their number."""


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


class _IoVec(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("size", ctypes.c_size_t))


class _MessageHeader(ctypes.Structure):
    _fields_ = (
        ("name", ctypes.c_void_p), ("name_bytes", ctypes.c_uint32),
        ("vectors", ctypes.POINTER(_IoVec)), ("vector_count", ctypes.c_size_t),
        ("control", ctypes.c_void_p), ("control_bytes", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )  # fmt: skip


class _Message(ctypes.Structure):
    _fields_ = (("header", _MessageHeader), ("sent_bytes", ctypes.c_uint))


class _AtOnce:
    """Sends many datagrams with one system call."""

    def __init__(self, ports: Sequence[int], data: bytes) -> None:
        self._call = ctypes.CDLL(None, use_errno=True).sendmmsg
        self._data = ctypes.create_string_buffer(data, len(data))
        self._vector = _IoVec(ctypes.addressof(self._data), len(data))
        names = [
            struct.pack("=H", socket.AF_INET)
            + struct.pack("!H4s8x", port, socket.inet_aton(LOOPBACK))
            for port in ports
        ]
        self._names = [ctypes.create_string_buffer(name, len(name)) for name in names]
        self._messages = (_Message * (_AT_ONCE + len(ports)))()
        self._next = 0
        for number, message in enumerate(self._messages):
            header = message.header
            name = self._names[number % len(ports)]
            header.name, header.name_bytes = ctypes.addressof(name), len(name)
            header.vectors, header.vector_count = ctypes.pointer(self._vector), 1

    def __call__(self, endpoint: socket.socket, most: int) -> int:
        first = ctypes.byref(self._messages, self._next * ctypes.sizeof(_Message))
        sent = max(int(self._call(endpoint.fileno(), first, min(most, _AT_ONCE), 0)), 0)
        self._next = (self._next + sent) % len(self._names)
        return sent


class _OneByOne:
    """Sends one datagram per call, where sendmmsg is not available."""

    def __init__(self, ports: Sequence[int], data: bytes) -> None:
        self._ports = itertools.cycle(ports)
        self._data = data

    def __call__(self, endpoint: socket.socket, most: int) -> int:
        count = min(most, _AT_ONCE)
        for port in itertools.islice(self._ports, count):
            endpoint.sendto(self._data, (LOOPBACK, port))
        return count


@contextmanager
def _sending(ports: Sequence[int]) -> Iterator[Send]:
    kind = _AtOnce if sys.platform == "linux" else _OneByOne
    send = kind(ports, datagram())
    endpoints = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(_SENDERS)]
    turn = 0

    def some(most: int) -> int:
        nonlocal turn
        turn = (turn + 1) % _SENDERS
        return send(endpoints[turn], most)

    yield some
    for endpoint in endpoints:
        endpoint.close()


def flood(ports: Sequence[int], seconds: float, rate_hz: float | None) -> Flood:
    """Send to ports in turn.

    Args:
        ports: destination ports.
        seconds: duration.
        rate_hz: total rate of datagrams; None: as fast as possible.
    """
    sent = 0
    with _sending(ports) as send:
        begun_s = time.monotonic()
        while (passed_s := time.monotonic() - begun_s) < seconds:
            due = _AT_ONCE if rate_hz is None else round(rate_hz * passed_s) - sent
            if due > 0:
                sent += send(due)
            else:
                time.sleep(min(_CHUNK_S, 1 / (rate_hz or 1)))
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
