"""What is measured of a machine, and what a scenario wants of it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from noack.config.scenario import Scenario
from noack.core.clock import NS_PER_S


class RunRequirements(NamedTuple):
    """What a scenario asks of the machine; times are wall time."""

    name: str
    duration_s: float
    period_ns: int
    """Of the plant's steps."""
    allowance_ns: int
    """By how much the certificates let updates and inputs be late."""
    realtime: bool
    """Whether real-time settings are asked for."""
    fifo_priority: int
    spin_us: float
    ports: Mapping[str, int]
    """By their keys; those that are 0, any free one, are not among them."""

    @property
    def rate_hz(self) -> float:
        """Steps of the plant per wall second."""
        return NS_PER_S / self.period_ns


def requirements_of(resolved: Scenario) -> RunRequirements:
    """Return what a resolved scenario asks of the machine that it runs on."""
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
    """How late a loop of the plant's rate woke up that had nothing to do."""

    wakes: int
    p50_us: float
    p99_us: float
    max_us: float
    beyond: int
    """How many times by more than the certificates allow."""


class RoundTrips(NamedTuple):
    """Datagrams that another process sent back over UDP on the loopback."""

    sent: int
    lost: int
    p50_us: float
    p99_us: float


class Buffer(NamedTuple):
    """A socket's receive buffer, as a process of a run has it."""

    datagrams: int
    """Datagrams of a run that it held when nobody read."""
    granted_bytes: int
    most_bytes: int | None
    """What the system grants without privileges; None if it does not say."""


class Disk(NamedTuple):
    """Where run directories are made."""

    folder: str
    free_bytes: int
    needed_bytes: int
    """Of the scenario's rows, until its run has ended."""
    write_bytes_per_s: float


@dataclass(frozen=True)
class MachineFacts:
    """Everything that was measured. What failed is the line that says why."""

    cores: int
    """That this process may use."""
    cores_online: int
    load: float | None
    """Processes that wanted a core, on average over the last minute."""
    governor: str | None
    """How the frequency of the first core is chosen; None if the system does not say."""
    granted: Mapping[str, str]
    """Real-time settings, and what became of them (``realtime``)."""
    timer_resolution_ns: int
    timer_slack_ns: int | None
    plain: Lateness | str
    """Without real-time settings."""
    realtime: Lateness | str
    """With those that were granted."""
    round_trips: RoundTrips | str
    buffer: Buffer | str
    ports_taken: Sequence[str]
    """A line for each of the scenario's ports that cannot be had."""
    control: float | str
    """Seconds that a question took over the control plane (zenoh, TCP on the loopback)."""
    disk: Disk | str
    runtime_folder: str | None
    """Why the folder for the user's private files cannot be used; None if it can."""
    cache: bool
    """Whether compiled code is kept from one run to the next."""
    display: bool
    viewer: str | None
    """Version of rerun; None if it cannot be imported."""
    extras: Mapping[str, bool]
    """Which extras of noack are installed."""
    versions: Mapping[str, str | None]
    """Of Python and of the libraries that a run depends on."""
