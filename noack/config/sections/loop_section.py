"""One entry of ``[[loops]]``: a loop, or several of a kind, that share the run's network."""

from typing import Annotated, Any, Literal, Self

from pydantic import Field, FiniteFloat, model_validator

from noack.settings.section import ScenarioSection, Seed

NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$"
MOST_LOOPS = 65_535
"""Largest number of loops in a run: datagrams carry the loop's number in 16 bits."""
SHARED = (
    "horizon_s", "speed", "start_within_s", "network", "certificate", "clocks", "recovery",
    "changes", "ports", "realtime", "loops",
)  # fmt: skip
"""Keys of a scenario that all its loops share."""

Table = dict[str, Any]


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

    name: Annotated[str, Field(pattern=NAME_PATTERN)]
    """Names the loop; with count = N > 1 the loops are NAME-1 to NAME-N."""
    count: Annotated[int, Field(ge=1, le=MOST_LOOPS)] = 1
    """Number of loops; each draws its plant, initial state, disturbances, noise and phase."""
    phase: Annotated[FiniteFloat, Field(ge=0, lt=1)] | None = None
    """Start of the loop after that of the run, as a share of the time between two transmissions of
    a periodic trigger, or else between two measurements. By default drawn by seed, and 0 for the
    first loop of the run."""
    scenario: str | Table | None = None
    """Another scenario file: the loop has its mode, model, plant, trigger, observer and controller
    in place of those of the top level. A path relative to this file, or the name of a shipped
    scenario. A network, certificate or changes in it must be those of this run; its other keys have
    no effect. Loading the scenario replaces the name by the tables."""
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
    seeds: LoopSeeds = LoopSeeds.model_construct()

    @model_validator(mode="before")
    @classmethod
    def _check(cls, content: Any) -> Any:
        for key in SHARED:
            if isinstance(content, dict) and key in content:
                raise ValueError(f"{key}: all loops share it; set it at the top level")
        if isinstance(content, dict) and not isinstance(content.get("scenario", ""), str | dict):
            raise ValueError("scenario: should be the name of a scenario file, in quotes")
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
