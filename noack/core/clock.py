"""Simulated time: integer nanoseconds since the run's epoch.

Machines never read a clock; shells pass ``now_ns`` in. ``speed`` is simulated time per wall time.
"""

import time
from collections.abc import Callable
from typing import Any

from noack.core.slewed_clock import SlewedClock

NS_PER_S = 1_000_000_000


class RunClock:
    """Simulated time tied to the machine's monotonic clock.

    ``epoch_ns`` is the clock's reading at simulated time 0, common to all processes of a run;
    ``speed`` is simulated seconds per wall second.
    """

    def __init__(
        self,
        epoch_ns: int,
        speed: float = 1.0,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        if not speed > 0:
            raise ValueError(f"speed must be positive, not {speed}")
        self.epoch_ns = epoch_ns
        self.speed = speed
        self._monotonic_ns = monotonic_ns

    def now_ns(self) -> int:
        """Simulated nanoseconds since the run's epoch."""
        wall_ns = self._monotonic_ns() - self.epoch_ns
        return wall_ns if self.speed == 1.0 else int(wall_ns * self.speed)

    def set_core(self, clock: Any) -> None:
        """Let a ``noack_clock`` of the core read as this clock does, if it reads this host's."""
        clock.epoch_ns, clock.speed, clock.slew_ppb = self.epoch_ns, self.speed, 0


class SlewedRunClock(RunClock):
    """Simulated time tied to another host's clock, as this host knows it.

    Args:
        epoch_ns: the other clock's reading at simulated time 0.
        speed: simulated seconds per second of the other clock.
        slewed: the other clock, as this host knows it.
        own_ns: this host's monotonic clock.
    """

    def __init__(
        self,
        epoch_ns: int,
        speed: float,
        slewed: SlewedClock,
        own_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        super().__init__(epoch_ns, speed, lambda: slewed.now_ns(own_ns()))
        self._slewed = slewed

    def set_core(self, clock: Any) -> None:
        """Let a ``noack_clock`` of the core read as this clock does, until the next estimate."""
        super().set_core(clock)
        slew = self._slewed.slew
        clock.slew_ppb, clock.since_ns = slew.slew_ppb, slew.since_ns
        clock.begun_ns, clock.target_ns = slew.begun_ns, slew.target_ns
