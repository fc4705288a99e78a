"""What a user wants of a new loop: the plant, allowed errors, and settings that are not to be chosen."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from cosim.studies.new_loop.linear_model import LinearModel
from netem.core.settings_section import ReadTable
from noack.plants.linear import LinearSettings


@dataclass(frozen=True)
class Choices:
    """The plant's model, and what a new scenario keeps whatever is tried."""

    model: LinearModel
    path: Path
    """The file that the scenario will have; file names in it are relative to its folder."""
    fixed_settings: ReadTable
    """Values by the keys of a scenario."""
    allowed: Mapping[str, float]
    """Allowed errors by the names of states."""

    @property
    def is_linear(self) -> bool:
        """Whether the plant is its own linear model."""
        return isinstance(self.model.plant.system, LinearSettings)

    def leaves(self, *keys: str) -> bool:
        """Return whether none of these keys has a value that must be kept."""
        return self.fixed_settings.keys().isdisjoint(keys)
