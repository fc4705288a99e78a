"""Loops that tick at a fixed rate and record each tick's lateness: ours and asyncio's."""

import argparse
import asyncio
import json
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from benchmarks._report import MeasurementError
from cosim.doctor.probe import idle_lateness_ns
from noack.core.clock import NS_PER_S
from noack.runtime.real_time_loop import realtime

FIFO_PRIORITY = 50


class Ticks(NamedTuple):
    """Lateness of a session's ticks, µs."""

    p50_us: float
    p99_us: float
    max_us: float
    granted: dict[str, str]


def ticks(kind: str, seconds: float, period_us: int, *, asked: bool) -> Ticks:
    """Run a loop in a separate process.

    Args:
        kind: one of LOOPS.
        seconds: duration.
        period_us: time between two ticks.
        asked: whether it requests real-time settings.

    Raises:
        MeasurementError: the process failed.
    """
    command = [
        sys.executable, "-m", "benchmarks._ticks", kind,
        "--count", str(round(seconds * 1e6 / period_us)), "--period-us", str(period_us),
        *(("--realtime",) if asked else ()),
    ]  # fmt: skip
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode != 0:
        raise MeasurementError(f"the {kind} loop ended with {done.returncode}")
    return Ticks(*json.loads(done.stdout))


def _run_loop(count: int, period_ns: int) -> Sequence[int]:
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


LOOPS: dict[str, Callable[[int, int], Sequence[int]]] = {
    "run_loop": _run_loop,
    "asyncio": _asyncio,
}


def main() -> None:
    """Run one loop and print its lateness."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kind", choices=LOOPS)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--period-us", type=int, default=1000)
    parser.add_argument("--realtime", action="store_true")
    options = parser.parse_args()
    with realtime(options.realtime, FIFO_PRIORITY) as granted:
        late_ns = LOOPS[options.kind](options.count, options.period_us * 1000)
    p50_ns, p99_ns, max_ns = np.quantile(late_ns, [0.5, 0.99, 1.0])
    print(json.dumps([p50_ns / 1e3, p99_ns / 1e3, max_ns / 1e3, granted]))


if __name__ == "__main__":
    main()
