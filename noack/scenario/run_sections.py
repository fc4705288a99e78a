"""The tables of a scenario that describe the run: all but those of a loop, and ``[[loops]]``."""

from typing import Annotated, Literal, Self

from pydantic import Field, FiniteFloat, field_validator, model_validator

from netem.core.clock import NS_PER_S
from netem.core.settings_section import FolderName, ScenarioSection, Seed, Table
from noack.scenario.runtime_parameters import full_key

Port = Annotated[int, Field(ge=0, le=65535)]


class CertificateSection(ScenarioSection):
    """Additional tolerance of the certificates, beyond the run's own schedule."""

    late_periods: Annotated[int, Field(ge=0, le=1000)] = 2
    """Updates and inputs may be late by this number of plant steps."""
    network_delay_s: Annotated[FiniteFloat, Field(ge=0, le=3600)] | None = None
    """The network may delay updates by this time; a longer delay voids the certificates. By default
    the longest delay of the network's impairments; with a queue, certificates need this key."""
    exceedance_probability: Annotated[FiniteFloat, Field(ge=1e-300, le=0.5)] = 1e-6
    """Normally distributed disturbances and noise have no bound. The certificates assume one that a
    run exceeds with at most this probability."""
    prove: bool = True
    """At the end of a run, search for witnesses of the certificates' bounds, for some seconds."""
    paper: bool = False
    """Check the paper's statements and assumptions in runs, too: they are about a continuous trigger and a
    network without delay, which no run has."""


class ClocksSection(ScenarioSection):
    """The clocks of a run on several hosts, which chrony or PTP disciplines."""

    largest_error_us: Annotated[FiniteFloat, Field(gt=0, le=1e6)] = 1000.0
    """How far the clock of a host may be off, in µs: the run does not start if chrony's bound is
    larger. Without chrony this is taken as the bound."""


class ScheduledChange(ScenarioSection):
    """Settings that change at a time during the run."""

    at_s: Annotated[FiniteFloat, Field(ge=0, le=1e7)]
    """Simulated time at which the new values take effect."""
    set: Annotated[Table, Field(min_length=1)]
    """The new values by their keys, e.g. "network.loss.probability" = 0.9: the keys of
    network.loss, network.mansd, controller.setpoint, and the numbers of the trigger."""

    @field_validator("set")
    @classmethod
    def _with_full_keys(cls, entries: Table) -> Table:
        settings = {full_key(name): value for name, value in entries.items()}
        if len(settings) < len(entries):
            raise ValueError("a key is given twice, by its short name, too")
        return settings

    @property
    def at_ns(self) -> int:
        """That time in nanoseconds."""
        return round(self.at_s * NS_PER_S)


class SeedsSection(ScenarioSection):
    """Seeds of the named random streams; they are independent of each other."""

    plant: Seed = 0
    """Draw of the true plant from its uncertainty box."""
    initial_state: Seed = 0
    """Draw of x(0)."""
    loss: Seed = 0
    """The network's losses."""
    disturbance: Seed = 0
    """The plant's random disturbances."""
    noise: Seed = 0
    """The measurements' noise."""


class PortsSection(ScenarioSection):
    """UDP ports on the loopback interface; 0 takes a free one."""

    plant: Port = 0
    """Port at which the plant receives actuation."""
    sensor: Port = 0
    """Port at which the sensor receives measurements."""
    netem: Port = 0
    """Port at which the network receives the sensor's updates."""
    controller: Port = 0
    """Port at which the controller receives the delivered updates."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        keys_by_port: dict[int, str] = {}
        for key in type(self).model_fields:
            port = getattr(self, key)
            if port and port in keys_by_port:
                raise ValueError(
                    f"{key}: port {port} is already given to {keys_by_port[port]}; take another, or 0 for any"
                )
            keys_by_port[port] = key
        return self


class RealtimeSection(ScenarioSection):
    """Real-time settings of the loop's processes; each is applied if the system permits it."""

    enabled: bool = True
    """Ask for SCHED_FIFO, locked memory, the shortest timer slack and no deep idle states."""
    fifo_priority: Annotated[int, Field(ge=1, le=98)] = 50
    """SCHED_FIFO priority of the controller; with ``pin_cores`` the emulator, the sensor and the
    plant have 1, 2 and 3 less, at least 1."""
    pin_cores: bool = True
    """With SCHED_FIFO: the plant runs on the first core, sensor, emulator and controller on the
    second; a receiver interrupts its sender."""
    spin_us: Annotated[FiniteFloat, Field(ge=0, le=1000)] = 0.0
    """Busy-wait this long before each deadline; this takes time from other processes on the
    core."""


MOST_LOOPS = 65_535
"""Largest number of loops in a run: datagrams carry the loop's number in 16 bits."""
SHARED = (
    "horizon_s", "speed", "start_within_s", "network", "certificate", "clocks", "changes",
    "ports", "realtime", "loops",
)  # fmt: skip
"""Keys of a scenario that all its loops share."""


class LoopSeeds(ScenarioSection):
    """Seeds that an entry of ``[[loops]]`` sets itself; all loops of the entry use them."""

    plant: Seed | None = None
    """Draw of the true plant from its uncertainty box."""
    initial_state: Seed | None = None
    """Draw of x(0), and of the phase."""
    disturbance: Seed | None = None
    """The plant's random disturbances; with one seed, all loops have the same disturbance."""
    noise: Seed | None = None
    """The measurements' noise."""


class LoopSection(ScenarioSection):
    """A loop, or ``count`` loops, on the run's network.

    A loop is the scenario's top level, or that of the entry's scenario file, with the keys of this
    entry in place of its own. A table that names its kind (``trigger.policy``, ``observer.kind``,
    ``controller.kind``; ``model.name``, ``model.A`` or ``model.file``) replaces the whole table.
    """

    name: FolderName
    """Names the loop; with count = N > 1 the loops are NAME-1 to NAME-N."""
    count: Annotated[int, Field(ge=1, le=MOST_LOOPS)] = 1
    """Number of loops; each draws its plant, initial state, disturbances, noise and phase."""
    phase: Annotated[FiniteFloat, Field(ge=0, lt=1)] | None = None
    """Start of the loop after that of the run, as a share of the time between two transmissions of
    a periodic trigger, or else between two measurements. By default drawn by seed, and 0 for the
    first loop of the run."""
    scenario: str | Table | None = None
    """Another scenario file: the loop has its mode, model, plant, trigger, observer and controller
    in place of those of the top level. A name is relative to this file, or that of a shipped
    scenario. The other keys of that file have no effect: the run has one network. Loading the
    scenario replaces the name by the tables."""
    mode: Literal["model", "zoh"] | None = None
    """The loop's mode."""
    model: Table | None = None
    """Keys of the loop's model."""
    plant: Table | None = None
    """Keys of the loop's plant."""
    trigger: Table | None = None
    """Keys of the loop's trigger."""
    observer: Table | None = None
    """Keys of the loop's observer."""
    controller: Table | None = None
    """Keys of the loop's controller."""
    outputs: list[Table] | None = None
    """The loop's outputs."""
    seeds: LoopSeeds = LoopSeeds.model_construct()

    @model_validator(mode="before")
    @classmethod
    def _check(cls, content: object) -> object:
        for key in SHARED:
            if isinstance(content, dict) and key in content:
                raise ValueError(f"{key}: all loops share it; set it at the top level")
        scenario = content.get("scenario") if isinstance(content, dict) else None
        if scenario is not None and not isinstance(scenario, str | dict):
            raise ValueError("scenario: expected the name of a scenario file, in quotes")
        return content

    @model_validator(mode="after")
    def _check_name(self) -> Self:
        if len(self.names[-1]) > 64:
            raise ValueError(f"name: too long; with count = {self.count} it gets a number")
        return self

    @property
    def names(self) -> list[str]:
        """The names of the loops."""
        if self.count == 1:
            return [self.name]
        width = len(str(self.count))
        return [f"{self.name}-{number:0{width}}" for number in range(1, self.count + 1)]
