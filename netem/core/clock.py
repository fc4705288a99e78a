"""Simulated time: integer nanoseconds since the run's epoch.

Machines never read a clock; shells pass ``now_ns`` in. ``speed`` is simulated time per wall time.
On several hosts, :mod:`noack.runtime.host_clocks` gives each process its epoch.
"""

import time
import uuid
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from netem.core.core_library import CData  # loads the core

NS_PER_S = 1_000_000_000
NEVER_NS = 2**63 - 1
"""A time that never comes."""
_BOOT = Path("/proc/sys/kernel/random/boot_id")
_NAMESPACE = Path("/proc/self/ns/time")


class RunClock:
    """Simulated time tied to the machine's monotonic clock.

    ``epoch_ns`` is the clock's reading at simulated time 0; ``speed`` is simulated seconds per wall second.
    """

    def __init__(
        self, epoch_ns: int, speed: float = 1.0, monotonic_ns: Callable[[], int] = time.monotonic_ns
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

    def set_core(self, clock: "CData") -> None:
        """Let a ``noack_clock`` of the core read as this clock does."""
        clock.epoch_ns, clock.speed = self.epoch_ns, self.speed


def clock_identity() -> str:
    """Return a name of this process's monotonic clock; processes with the same name share it.

    On Linux the clock is that of the boot, with the offset of the time namespace. Elsewhere the
    name is a number of the machine.
    """
    with suppress(OSError):
        namespace = ""
        with suppress(OSError):  # a kernel before 5.6 has no time namespaces
            namespace = str(_NAMESPACE.readlink())
        return f"{_BOOT.read_text(encoding='ascii').strip()} {namespace}".strip()
    return f"machine {uuid.getnode():x}"
