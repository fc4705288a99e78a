"""Clocks: integer nanoseconds of simulated time since the run's epoch.

The core never reads a clock; shells pass ``now_ns`` in. ``speed`` is simulated time per wall time.
"""

import time
from collections.abc import Callable
from typing import Protocol

NS_PER_S = 1_000_000_000


class Clock(Protocol):
    """Something that tells simulated time."""

    def now_ns(self) -> int:
        """Simulated nanoseconds since the run's epoch (negative before it)."""
        ...


class ManualClock:
    """A clock that stands still until it is set; for simulation, replay and tests."""

    def __init__(self, now_ns: int = 0) -> None:
        self._now_ns = now_ns

    def now_ns(self) -> int:
        """Simulated nanoseconds since the run's epoch."""
        return self._now_ns

    def advance_to(self, now_ns: int) -> None:
        """Move to ``now_ns``.

        Raises:
            ValueError: ``now_ns`` lies in the past.
        """
        if now_ns < self._now_ns:
            raise ValueError(f"time cannot go back from {self._now_ns} ns to {now_ns} ns")
        self._now_ns = now_ns


class RunClock:
    """Simulated time tied to the machine's monotonic clock by an epoch and a speed.

    Args:
        epoch_ns: monotonic clock reading at simulated time 0, common to all processes of a run.
        speed: simulated seconds per wall second, positive.
        monotonic_ns: the wall clock; the system's monotonic clock unless a test says otherwise.
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

    def wall_s_until(self, t_ns: int) -> float:
        """Wall seconds from now until simulated time ``t_ns``; negative once it has passed."""
        wall_ns = self._monotonic_ns() - self.epoch_ns
        return (t_ns / self.speed - wall_ns) * 1e-9
