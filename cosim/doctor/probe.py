"""Separate processes that measure: ``python -m cosim.doctor.probe wake|echo``."""

import json
import socket
import sys
import time
from collections.abc import Sequence

from noack.core.clock import NS_PER_S, RunClock
from noack.protocol.machine_interface import Notice, Record
from noack.runtime.address import LOOPBACK
from noack.runtime.real_time_loop import run_loop
from noack.runtime.real_time_settings import realtime

_WARM_UP = 20
"""Wake-ups before the measurement, to warm up the code."""
_IDLE_S = 10.0


def wake(period_ns: int, duration_s: float, priority: int, spin_us: float) -> dict[str, object]:
    """Wake up periodically, as a process of a run does, without and with real-time settings.

    Returns:
        ``plain`` and ``realtime``: lateness in ns; ``granted``: the settings.
    """
    found: dict[str, object] = {}
    # Timer slack and locked memory cannot be undone in a process: measure without them first.
    for name, enabled in (("plain", False), ("realtime", True)):
        with realtime(enabled, priority, place=0) as granted:
            found |= {name: idle_lateness_ns(period_ns, duration_s, spin_us), "granted": granted}
    return found


def idle_lateness_ns(period_ns: int, duration_s: float, spin_us: float = 0.0) -> Sequence[int]:
    """Return the lateness of each wake-up of a run's loop that has nothing else to do, in ns."""
    metronome, wall = _Metronome(period_ns), RunClock(time.monotonic_ns())
    end_ns = round(duration_s * NS_PER_S) + _WARM_UP * period_ns
    run_loop(
        metronome, _Nothing(), wall, _Nothing(), end_ns=end_ns, stop=lambda: False, spin_us=spin_us
    )
    return metronome.late_ns[_WARM_UP:]


class _Metronome:
    """A machine that only records its lateness."""

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._due_ns = period_ns
        self.late_ns: list[int] = []

    def handle(self, message: object, now_ns: int) -> Sequence[object]:
        return ()

    def on_timer(self, now_ns: int) -> Sequence[object]:
        self.late_ns.append(now_ns - self._due_ns)
        self._due_ns += self._period_ns
        return ()

    def next_deadline_ns(self) -> int:
        return self._due_ns


class _Nothing:
    """A socket and a record that do nothing."""

    watched: Sequence[int] = ()

    def receive(self, readable: int) -> None:
        return None

    def send(self, message: object) -> None:
        pass

    def tend(self, now_ns: int) -> Sequence[Notice]:
        return ()

    def append(self, record: Record) -> None:
        pass

    def extend_table(self, table: str, rows: object) -> None:
        pass

    def notice(self, notice: Notice) -> None:
        pass

    def flush(self) -> None:
        pass


def echo() -> None:
    """Print a port and echo datagrams that arrive there; an empty datagram ends it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as endpoint:
        endpoint.bind((LOOPBACK, 0))
        endpoint.settimeout(_IDLE_S)
        print(endpoint.getsockname()[1], flush=True)
        while True:
            data, source = endpoint.recvfrom(2048)
            if not data:
                return
            endpoint.sendto(data, source)


if __name__ == "__main__":
    if sys.argv[1] == "echo":
        echo()
    else:
        period_ns, duration_s, priority, spin_us = sys.argv[2:]
        found = wake(int(period_ns), float(duration_s), int(priority), float(spin_us))
        print(json.dumps(found))
