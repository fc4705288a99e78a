"""A process that measures wake-ups: ``python -m cosim.doctor.probe``."""

import json
import sys
import time
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from netem.core.clock import NS_PER_S, RunClock
from netem.core.realtime_settings import realtime
from noack.protocol.roles import LOOP_ROLES, Notice, Record
from noack.protocol.wire_format import KEY_BYTES, Wire
from noack.runtime.drivers.live_driver import LiveDriver
from noack.runtime.drivers.real_time_loop import RecordSink, run_loop
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import validate
from plant_server.plant import plants_of

_WARM_UP = 20
"""Wake-ups before the measurement, to warm up the code."""


def wake(
    period_ns: int, duration_s: float, priority: int, spin_us: float, *, is_realtime: bool
) -> dict[str, object]:
    """Wake up periodically, as a process of a run does.

    Returns:
        ``late_ns``: lateness of each wake-up; ``settings``: which real-time settings are applied.
    """
    with realtime(is_realtime, priority, place=0, places=len(LOOP_ROLES)) as settings:
        return {"late_ns": idle_lateness_ns(period_ns, duration_s, spin_us), "settings": settings}


def idle_lateness_ns(period_ns: int, duration_s: float, spin_us: float = 0.0) -> Sequence[int]:
    """Return the lateness of each wake-up of a run's loop that has nothing else to do, in ns."""
    end_ns = round(duration_s * NS_PER_S) + _WARM_UP * period_ns
    idle_loop = {
        "name": "idle_loop",
        "horizon_s": end_ns / NS_PER_S,
        "model": {"name": "double_integrator"},
        "plant": {"initial_state": [0.0, 0.0], "rate_hz": NS_PER_S / period_ns},
        "trigger": {"beta": 1.0, "alpha_per_s": 1.0},
        "network": {"mansd": 0, "loss": {"model": "lossless"}},
    }
    plant = plants_of((resolve(validate(idle_loop, "the plant of a measurement")),))
    driver = LiveDriver(plant, Wire(0, bytes(KEY_BYTES)), spin_ns=round(spin_us * 1000))
    ticks, clock = _TickRecord(), RunClock(time.monotonic_ns())
    run_loop(driver, ticks, clock, ticks, end_ns=end_ns, stop=lambda: False)
    return ticks.late_ns[_WARM_UP:]


class _TickRecord:
    """A record that keeps the lateness of each tick, and sockets that do nothing."""

    def __init__(self) -> None:
        self.late_ns: list[int] = []

    def extend_table(self, table: str, rows: NDArray[np.void]) -> None:
        self.late_ns += (rows["now_ns"] - rows["t_ns"]).tolist()

    def do_housekeeping(self, now_ns: int, sink: RecordSink) -> None:
        pass

    def append(self, record: Record) -> None:
        pass

    def notice(self, notice: Notice) -> None:
        pass

    def flush(self) -> None:
        pass


if __name__ == "__main__":
    period_ns, duration_s, priority, spin_us, is_realtime = sys.argv[1:]
    numbers = int(period_ns), float(duration_s), int(priority), float(spin_us)
    print(json.dumps(wake(*numbers, is_realtime=bool(int(is_realtime)))))
