"""How long a launcher waits for its processes: longer on a loaded machine."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from netem.core.system_processes import cores as usable_cores

_MOST_SLOWED = 20.0
"""Factor by which a loaded machine extends a limit at most."""
_OVERLOADED = 1.5
"""From this slow-down on, the message names the load as the likely cause."""


@dataclass
class WaitLimit:
    """The time that the processes of a run have to get ready, or to end.

    When the system load (one-minute average) is k > 1 times the number of cores, a process gets 1/k
    of a core, and a second of waiting counts as 1/k s, but at least as 1/20 s.
    """

    within_s: float
    cores: int = field(default_factory=usable_cores)
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

    @property
    def load_text(self) -> str:
        """The newest load, for messages."""
        return f"a load of {self.load:.1f} on {self.cores} cores"

    @property
    def is_loaded(self) -> bool:
        """Whether the load extended the limit, so that it is the likely cause."""
        return self.waited_s > _OVERLOADED * self.counted_s

    def explain_start(self, roles: Sequence[str]) -> str:
        """Why processes were not ready within the limit, and what would help."""
        were = "was" if len(roles) == 1 else "were"
        waited = f"{', '.join(roles)} {were} not ready in time: waited {self.waited_s:.0f} s"
        if self.is_loaded:
            return (
                f"{waited}; likely cause: {self.load_text}; start fewer runs at once, or set "
                f"start_within_s above {self.within_s:g}"
            )
        return f"{waited} (start_within_s); {self.load_text} is not the likely cause"

    def explain_missing(self, roles: Sequence[str]) -> str:
        """Which processes that people start did not join within the limit, and how to start them."""
        commands = ", ".join(f"`noack {role}`" for role in roles)
        return (
            f"{', '.join(roles)} did not join in time: waited {self.waited_s:.0f} s (start_within_s); "
            f"start with {commands}"
        )

    def explain_end(self) -> str:
        """Why a run did not end within the limit after its horizon, and what would help."""
        if self.is_loaded:
            return f"likely cause: {self.load_text}; start fewer runs at once"
        return "likely cause: too slow, stopped, or hung in code of yours; reduce the speed or the rates"
