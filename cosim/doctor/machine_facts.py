"""The measurements of a machine, and the requirements of a scenario."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from noack.config.scenario import Scenario
from noack.core.clock import NS_PER_S


class RunRequirements(NamedTuple):
    """What a scenario requires of the machine; times are wall time."""

    name: str
    duration_s: float
    period_ns: int
    """Period of the plant's steps."""
    allowance_ns: int
    """Lateness of updates and inputs that the certificates allow."""
    realtime: bool
    """Whether the scenario asks for real-time settings."""
    fifo_priority: int
    spin_us: float
    ports: Mapping[str, int]
    """Ports by key, without ports that are 0 (any free port)."""

    @property
    def rate_hz(self) -> float:
        """Steps of the plant per wall second."""
        return NS_PER_S / self.period_ns


def requirements_of(resolved: Scenario) -> RunRequirements:
    """Return what a resolved scenario requires of the machine."""
    period_ns = round(resolved.timing.plant_period_ns / resolved.speed)
    settings = resolved.realtime
    ports = {name: port for name, port in resolved.ports.model_dump().items() if port}
    return RunRequirements(
        name=resolved.name,
        duration_s=resolved.horizon_s / resolved.speed,
        period_ns=period_ns,
        allowance_ns=resolved.certificate.late_periods * period_ns,
        realtime=settings.enabled,
        fifo_priority=settings.fifo_priority,
        spin_us=settings.spin_us,
        ports=ports,
    )


class Lateness(NamedTuple):
    """Lateness of an idle loop that wakes up at the plant's rate."""

    wakes: int
    p50_us: float
    p99_us: float
    max_us: float
    beyond: int
    """Number of wake-ups that were later than the certificates allow."""


class RoundTrips(NamedTuple):
    """Round trips of datagrams to another process over UDP on the loopback."""

    sent: int
    lost: int
    p50_us: float
    p99_us: float


class Buffer(NamedTuple):
    """The receive buffer of a run's sockets."""

    datagrams: int
    """Number of a run's datagrams that it holds."""
    granted_bytes: int
    most_bytes: int | None
    """Largest size without privileges; None if unknown."""


class Disk(NamedTuple):
    """The folder of the run directories."""

    folder: str
    free_bytes: int
    needed_bytes: int
    """Space for the run's rows until the run has ended."""
    write_bytes_per_s: float


@dataclass(frozen=True)
class MachineFacts:
    """All measurements. A failed measurement is one line with the reason."""

    cores: int
    """Cores that this process may use."""
    cores_online: int
    load: float | None
    """Load average over the last minute."""
    governor: str | None
    """Frequency governor of the first core; None if unknown."""
    granted: Mapping[str, str]
    """For each real-time setting: applied or not permitted, as ``realtime`` reports it."""
    timer_resolution_ns: int
    timer_slack_ns: int | None
    plain: Lateness | str
    """Without real-time settings."""
    realtime: Lateness | str
    """With the real-time settings that are permitted."""
    round_trips: RoundTrips | str
    buffer: Buffer | str
    ports_taken: Sequence[str]
    """A line for each port of the scenario that is in use."""
    control: float | str
    """Seconds per query over the control plane (zenoh, over a Unix socket)."""
    disk: Disk | str
    runtime_folder: str | None
    """Why the folder for the user's private files cannot be used; None if it can."""
    display: bool
    viewer: str | None
    """Version of rerun; None if it cannot be imported."""
    extras: Mapping[str, bool]
    """Whether each extra of noack is installed."""
    versions: Mapping[str, str | None]
    """Versions of Python and of the libraries that a run depends on."""
