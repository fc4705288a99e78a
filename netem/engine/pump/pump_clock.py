"""The pump's time: simulated nanoseconds since the relay's start."""

from netem.engine.pump.pump_layout import Memory
from noack.runtime.native.libc_calls import CLOCK_MONOTONIC, clock_ns


def relay_time_ns(memory: Memory) -> int:
    """Read the clock; the same as :meth:`noack.core.clock.RunClock.now_ns`."""
    pump = memory.pump[0]
    return simulated_ns_of(memory, clock_ns(CLOCK_MONOTONIC, memory.time) - pump.epoch_ns)


def simulated_ns_of(memory: Memory, wall_ns: int) -> int:
    """Return the simulated time of a wall time."""
    speed = memory.pump[0].speed
    return wall_ns if speed == 1.0 else int(wall_ns * speed)


def wall_ns_of(memory: Memory, simulated_ns: int) -> int:
    """Return how long a simulated time lasts."""
    speed = memory.pump[0].speed
    return simulated_ns if speed == 1.0 else int(simulated_ns / speed)
