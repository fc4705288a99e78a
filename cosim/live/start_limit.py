"""Time limit of the start barrier, longer on a loaded machine.

When the system load (one-minute average) is k > 1 times the number of cores, a process gets 1/k of
a core, and a second of waiting counts as 1/k s, but at least as 1/20 s.
"""

import os
from dataclasses import dataclass, field

DEFAULT_S = 30.0
_MOST_SLOWED = 20.0
_OVERLOADED = 1.5
"""From this slow-down on, the message names the load as the likely cause."""


def _cores() -> int:
    return len(os.sched_getaffinity(0))


@dataclass
class StartLimit:
    """The time that the processes of a run have to get ready."""

    within_s: float
    cores: int = field(default_factory=_cores)
    waited_s: float = 0.0
    """Waited wall time, in seconds."""
    counted_s: float = 0.0
    """The part of it that counts."""
    load: float = 0.0
    """The newest load."""

    def wait(self, wall_s: float, load: float) -> None:
        """Count wall time under a system load."""
        self.load = load
        self.waited_s += wall_s
        self.counted_s += wall_s / min(max(load / self.cores, 1.0), _MOST_SLOWED)

    @property
    def is_reached(self) -> bool:
        """Whether the limit is reached."""
        return self.counted_s > self.within_s

    def explain(self) -> str:
        """Why the limit was reached, and what would help."""
        load = f"a load of {self.load:.1f} on {self.cores} cores"
        waited = f"not ready in time: waited {self.waited_s:.0f} s"
        if self.waited_s > _OVERLOADED * self.counted_s:
            return (
                f"{waited}; likely cause: {load}; start fewer runs at once, or set "
                f"start_within_s above {self.within_s:g}"
            )
        return f"{waited} (start_within_s); {load} is not the likely cause"
