"""The controller section of a scenario: one of the kinds in :mod:`noack.controllers`."""

from typing import TYPE_CHECKING

from noack.controllers.controller_settings import ControllerSettings
from noack.settings.registry import kinds_in, union_of

CONTROLLERS = kinds_in("noack.controllers", ControllerSettings)
"""Settings classes by kind."""

if TYPE_CHECKING:
    AnyController = ControllerSettings
else:
    AnyController = union_of(CONTROLLERS, default="linear")
