"""How long the launcher waits for its processes at the start: longer on a machine with much to do.

A second of waiting counts as a second while each process that wants to run has a core. When the
system's load (its average over a minute) is k times the number of cores, a process gets a k-th of
one, and a second counts as 1/k, but at least as 1/20.
"""

import os
from dataclasses import dataclass, field

DEFAULT_S = 30.0
_MOST_SLOWED = 20.0
_OVERLOADED = 1.5
"""A start that was slowed down by this factor on average has had more to wait for than itself."""


def _cores() -> int:
    return len(os.sched_getaffinity(0))


@dataclass
class StartLimit:
    """The time that the processes of a run have to come to its start.

    Args:
        within_s: limit for a machine that has nothing else to do, in seconds.
        cores: how many of them the launcher may use.
    """

    within_s: float
    cores: int = field(default_factory=_cores)
    waited_s: float = 0.0
    """Wall time."""
    counted_s: float = 0.0
    """What counts of it."""
    load: float = 0.0
    """The newest."""

    def wait(self, wall_s: float, load: float) -> None:
        """Count some wall time, during which the system had a load."""
        self.load = load
        self.waited_s += wall_s
        self.counted_s += wall_s / min(max(load / self.cores, 1.0), _MOST_SLOWED)

    @property
    def is_reached(self) -> bool:
        """Whether the time is up."""
        return self.counted_s > self.within_s

    def explain(self) -> str:
        """Why the time is up, and what would help."""
        load = f"a load of {self.load:.1f} on {self.cores} cores"
        waited = f"not ready in time: waited {self.waited_s:.0f} s"
        if self.waited_s > _OVERLOADED * self.counted_s:
            return (
                f"{waited}; likely cause: {load}; start fewer runs at once, or set "
                f"start_within_s above {self.within_s:g}"
            )
        return f"{waited} (start_within_s); {load} is not the likely cause"
