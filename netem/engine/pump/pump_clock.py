"""The pump's time: simulated nanoseconds since the relay's start."""

from netem.engine.pump.libc_calls import CLOCK_MONOTONIC, clock_ns
from netem.engine.pump.pump_layout import Memory


def relay_time_ns(memory: Memory) -> int:
    """Read the clock; the same as :meth:`noack.core.clock.RunClock.now_ns`."""
    pump = memory.pump[0]
    wall_ns = clock_ns(CLOCK_MONOTONIC, memory.time) - pump.epoch_ns
    return wall_ns if pump.speed == 1.0 else int(wall_ns * pump.speed)


def wall_ns_of(memory: Memory, simulated_ns: int) -> int:
    """Return how long a simulated time lasts."""
    speed = memory.pump[0].speed
    return simulated_ns if speed == 1.0 else int(simulated_ns / speed)
