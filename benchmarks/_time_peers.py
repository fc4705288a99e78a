"""The two programs of an exchange of timestamps, to be run on two hosts.

The reference prints its port and answers until its standard input closes. The client compares its
clock, which has an added drift, with the reference's, whose true offset is known, and prints its
figures as JSON; errors are those after the first half second. With ``--bare`` both are what a plain
NTP client and server do: no authentication, timestamps of the program, and the newest midpoint as
the offset, without a bound (RFC 5905).
"""

import argparse
import json
import select
import socket
import struct
import sys
import time
from collections.abc import Sequence
from contextlib import closing
from typing import Self

import numpy as np

from benchmarks._driven_clocks import DrivenClocks
from noack.core.clock import ClockOffset, Restart
from noack.runtime.address import Address
from noack.runtime.host_clocks.time_exchange import TimeClient, TimeReference, answering
from noack.runtime.real_time_loop import realtime

KEY = bytes(range(32))
CHECKS_AT_ONCE = 25
_PRIORITY = 40
_WAKE_S = 0.001
_START_NS = 500_000_000
_PACKET = struct.Struct("<qqq24x")  # 48 bytes, as NTP's


class Bare:
    """An end of a plain NTP exchange; the client takes the newest midpoint for the offset."""

    def __init__(self, clocks: DrivenClocks | None = None) -> None:
        self._clocks = clocks or DrivenClocks()
        self._endpoint = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.midpoint_ns: int | None = None

    @classmethod
    def reference(cls, listen: Address) -> Self:
        """Return an end that answers at an address."""
        made = cls()
        made._endpoint.bind(listen)
        return made

    @classmethod
    def client(cls, reference: Address, clocks: DrivenClocks) -> Self:
        """Return an end that asks a reference."""
        made = cls(clocks)
        made._endpoint.connect(reference)
        made._endpoint.setblocking(False)
        return made

    @property
    def address(self) -> Address:
        """Its own address."""
        name: Address = self._endpoint.getsockname()
        return name

    def fileno(self) -> int:
        """Return the descriptor to wait for."""
        return self._endpoint.fileno()

    def answer_all(self) -> None:
        """Answer the waiting request."""
        data, source = self._endpoint.recvfrom(100)
        received_ns = time.monotonic_ns()
        sent_ns = _PACKET.unpack(data)[0]
        self._endpoint.sendto(_PACKET.pack(sent_ns, received_ns, time.monotonic_ns()), source)

    def poll(self) -> list[Restart]:
        """Take the answer, or send a request if there is none."""
        try:
            data = self._endpoint.recv(100)
        except BlockingIOError:
            self._endpoint.send(_PACKET.pack(self._clocks.monotonic_ns(), 0, 0))
            return []
        now_ns = self._clocks.monotonic_ns()
        sent_ns, there_ns, answered_ns = _PACKET.unpack(data)
        self.midpoint_ns = (there_ns - sent_ns + answered_ns - now_ns) // 2
        return []

    def close(self) -> None:
        """Close the socket."""
        self._endpoint.close()


def run_reference(options: argparse.Namespace) -> None:
    """Answer until the standard input closes."""
    listen = (options.host, 0)
    end = Bare.reference(listen) if options.bare else TimeReference(listen, KEY)
    with closing(end):
        print(end.address[1], flush=True)
        if isinstance(end, TimeReference) and not options.answer_every_s:
            with answering(end):
                sys.stdin.read()
            return
        while not select.select([sys.stdin], (), (), options.answer_every_s)[0]:
            while select.select([end], (), (), 0 if options.answer_every_s else 0.1)[0]:
                end.answer_all()


def run_client(options: argparse.Namespace) -> None:
    """Check the bound against the true offset for a time; print the figures."""
    clocks = DrivenClocks(0, options.drift_ppb)
    address = (options.host, options.port)
    offset = ClockOffset(options.rate_ppb)
    period_ns = round(options.period_s * 1e9)
    bare = Bare.client(address, clocks) if options.bare else None
    client = bare or TimeClient(address, KEY, offset, period_ns=period_ns, clocks=clocks)
    errors_ns, estimates_ns = list[int](), list[int]()
    checks = outside = restarts = 0
    steady_ns = time.monotonic_ns() + _START_NS
    end_ns = steady_ns + round(options.seconds * 1e9)
    due_ns, turns, cpu_ns = 0, 0, 0
    with closing(client):
        while (now_ns := time.monotonic_ns()) < end_ns:
            is_due = now_ns >= due_ns
            readable, _, _ = select.select([client], (), (), 0 if is_due else _WAKE_S)
            if is_due or (readable and not options.late):
                begin_ns = time.thread_time_ns()
                restarts += len(client.poll())
                cpu_ns += time.thread_time_ns() - begin_ns
            if is_due:
                due_ns, turns = max(due_ns, now_ns - period_ns) + period_ns, turns + 1
            for _ in range(CHECKS_AT_ONCE):
                true_ns = time.monotonic_ns()
                added_ns = clocks.added_ns(true_ns)
                truth_ns = options.ahead_ns - added_ns
                found = offset.interval(true_ns + added_ns)
                estimate_ns = bare.midpoint_ns if bare else found and found.midpoint_ns
                if found is not None:
                    checks += 1
                    outside += not found.lower_ns <= truth_ns <= found.upper_ns
                if estimate_ns is not None and true_ns > steady_ns:
                    estimates_ns.append(abs(estimate_ns - truth_ns))
                    if found is not None:
                        errors_ns.append(found.error_ns)
    figures = {
        "checks": checks, "outside": outside, "restarts": restarts, "turns": turns,
        "exchanges": offset.exchanges, "cpu_us": cpu_ns / 1e3 / max(turns, 1),
    }  # fmt: skip
    print(
        json.dumps(figures | _quantiles("error", errors_ns) | _quantiles("estimate", estimates_ns))
    )


def _quantiles(name: str, values_ns: Sequence[int]) -> dict[str, float]:
    if not values_ns:
        return {}
    p50, p99, most = np.quantile(np.array(values_ns), (0.5, 0.99, 1)) / 1e3
    return {f"{name}_p50_us": p50, f"{name}_p99_us": p99, f"{name}_max_us": most}


def main() -> None:
    """Run a program."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks._time_peers")
    commands = parser.add_subparsers(required=True)
    reference = commands.add_parser("reference")
    reference.add_argument("--answer-every-s", type=float, default=0.0)
    reference.set_defaults(run=run_reference)
    client = commands.add_parser("client")
    client.add_argument("port", type=int)
    client.add_argument("--ahead-ns", type=int, default=0, help="reference minus this host's clock")
    client.add_argument("--drift-ppb", type=int, default=0)
    client.add_argument("--rate-ppb", type=int, default=ClockOffset().rate_ppb)
    client.add_argument("--period-s", type=float, default=0.02)
    client.add_argument("--seconds", type=float, default=2.0)
    client.add_argument("--late", action="store_true", help="read replies once a period only")
    client.set_defaults(run=run_client)
    for one in (reference, client):
        one.add_argument("host")
        one.add_argument("--bare", action="store_true")
        one.add_argument("--realtime", action="store_true", help="request real-time settings")
    options = parser.parse_args()
    with realtime(options.realtime, _PRIORITY):
        options.run(options)


if __name__ == "__main__":
    main()
