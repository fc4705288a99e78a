"""The plant system of a scenario: one of the kinds in :mod:`noack.plants`."""

from typing import TYPE_CHECKING

from noack.plants.plant_settings import PlantSettings
from noack.settings.registry import kinds_in, union_of

PLANTS = kinds_in("noack.plants", PlantSettings)
"""Settings classes by kind."""

if TYPE_CHECKING:
    AnyPlant = PlantSettings
else:
    AnyPlant = union_of(PLANTS, default="linear")
