"""The scenario: everything that defines a run, validated into frozen objects.

A scenario file is TOML; every key is documented here and in the exported JSON Schema. Unknown keys
are errors. :mod:`noack.config.resolution` replaces names and random draws by numbers.
"""

from typing import Annotated, Any, Literal, Self

from pydantic import Field, FiniteFloat, model_validator

from noack.config.feature_kinds import AnyController, AnyObserver, AnyTrigger
from noack.config.loops import check_loops
from noack.config.message_sizes import MessageSizes
from noack.config.scenario_changes import check_changes
from noack.config.scenario_checks import check_sections
from noack.config.sections.loop_section import NAME_PATTERN, LoopSection
from noack.config.sections.model_section import ModelSection
from noack.config.sections.network_section import NetworkSection
from noack.config.sections.plant_section import PlantSection
from noack.config.sections.run_sections import (
    CertificateSection,
    ClocksSection,
    PortsSection,
    RealtimeSection,
    RecoverySection,
    ScheduledChange,
    SeedsSection,
)
from noack.config.theory_coverage import TheoryCoverage
from noack.config.timing import Timing
from noack.controllers.linear_feedback import LinearFeedbackSettings
from noack.core.errors import CallerError
from noack.core.row_display import as_html, as_text
from noack.protocol.loop_protocol import PROTOCOLS, LoopProtocol
from noack.settings.section import ScenarioSection
from noack.trigger.decaying import DecayingSettings

MOST_CHANGES = 256  # largest number of scheduled changes in a run


class Scenario(ScenarioSection):
    """A run of the loop, completely described."""

    name: Annotated[str, Field(pattern=NAME_PATTERN)]
    """Names the run's directory: letters, digits, _ and -."""
    description: str = ""
    """What the scenario shows."""
    mode: Literal["model", "zoh"] = "model"
    """model: x_s and x_c follow Â + B̂K between updates; zoh: they hold the last update."""
    horizon_s: Annotated[FiniteFloat, Field(gt=0, le=1e7)]
    """Simulated length of the run."""
    speed: Annotated[FiniteFloat, Field(gt=0, le=1000)] = 1.0
    """Simulated time per wall time."""
    start_within_s: Annotated[FiniteFloat, Field(gt=0, le=86_400)] | None = None
    """The run ends if its processes are not ready within this wall time, which grows with the
    system's load, up to 20 times. By default 30, and unlimited if people start processes."""
    model: ModelSection
    plant: PlantSection
    trigger: AnyTrigger
    """When the sensor transmits."""
    observer: AnyObserver | None = None
    """How the sensor estimates the state from the measurements: a table with ``kind``. Without it,
    the measurement must be the state."""
    network: NetworkSection
    controller: AnyController = LinearFeedbackSettings.model_construct()
    certificate: CertificateSection = CertificateSection.model_construct()
    clocks: ClocksSection | None = None
    """The clocks of a run on several hosts. Without it, claims assume one clock."""
    recovery: RecoverySection = RecoverySection.model_construct()
    changes: Annotated[tuple[ScheduledChange, ...], Field(max_length=MOST_CHANGES)] = ()
    """Changes of settings during the run, in the order of time."""
    loops: Annotated[tuple[LoopSection, ...], Field(min_length=1)] | None = None
    """The loops on the network, if there are several."""
    seeds: SeedsSection = SeedsSection.model_construct()
    ports: PortsSection = PortsSection.model_construct()
    realtime: RealtimeSection = RealtimeSection.model_construct()

    def _rows(self) -> list[tuple[str, str]]:
        n, m = self.model.dimensions
        rows = [
            ("scenario", self.name + (f": {self.description}" if self.description else "")),
            ("mode", "model-based" if self.mode == "model" else "zero-order hold"),
            ("plant", f"{self.plant.system.kind}, n = {n}, m = {m}, {self.plant.rate_hz:g} Hz"),
            ("trigger", _said(self.trigger, "policy")),
            ("network", f"{_said(self.network.loss, 'model')}; M − 1 = {self.network.mansd}"),
            ("horizon", f"{self.horizon_s:g} s"),
        ]
        if self.loops:
            loops = (
                one.name if one.count == 1 else f"{one.count} x {one.name}" for one in self.loops
            )
            rows.append(("loops", ", ".join(loops)))
        return rows

    def __str__(self) -> str:
        """The most important settings, in a few lines."""
        return as_text(self._rows())

    def _repr_pretty_(self, printer: Any, cycle: bool) -> None:
        """Show the same text in IPython."""
        printer.text(str(self))

    def _repr_html_(self) -> str:
        """Show the same as a table in notebooks."""
        return as_html(self._rows())

    @property
    def timing(self) -> Timing:
        """Periods, phases and timeouts."""
        return Timing(self)

    @property
    def message_sizes(self) -> MessageSizes:
        """The number of vector entries in its messages."""
        return MessageSizes(self)

    @property
    def coverage(self) -> TheoryCoverage:
        """The parts of the theory that apply to it."""
        return TheoryCoverage(self)

    @property
    def decaying(self) -> DecayingSettings:
        """Return the trigger, if it is the paper's; raise CallerError for another policy."""
        if not isinstance(self.trigger, DecayingSettings):
            raise CallerError(
                f'trigger.policy: needs the paper\'s trigger, "decaying"; '
                f'this scenario has "{self.trigger.policy}"'
            )
        return self.trigger

    @property
    def protocol(self) -> LoopProtocol:
        """The settings that depend on whether updates are acknowledged."""
        return PROTOCOLS[self.network.protocol]

    @model_validator(mode="after")
    def _check(self) -> Self:
        check_sections(self)
        check_changes(self)
        check_loops(self)
        return self


def _said(section: ScenarioSection, kind: str) -> str:
    """Describe a section by its kind, and its values that differ from the defaults."""
    given = section.model_dump(mode="json", exclude_defaults=True, exclude={kind})
    values = (
        f"{key} = {'…' if isinstance(value, dict | list) else value}"
        for key, value in given.items()
    )
    return ", ".join((getattr(section, kind), *values))
