"""The kinds of controllers, disturbances, observers, plants and triggers in a scenario."""

from typing import TYPE_CHECKING

from noack.controllers.controller_settings import ControllerSettings
from noack.disturbances.disturbance_settings import DisturbanceSettings
from noack.observers.observer_settings import ObserverSettings
from noack.plants.plant_settings import PlantSettings
from noack.settings.registry import kinds_in, union_of
from noack.trigger.policy_settings import PolicySettings

# Settings classes by kind: a module in the folder adds its kind.
CONTROLLERS = kinds_in("noack.controllers", ControllerSettings)
DISTURBANCES = kinds_in("noack.disturbances", DisturbanceSettings)
OBSERVERS = kinds_in("noack.observers", ObserverSettings)
PLANTS = kinds_in("noack.plants", PlantSettings)
POLICIES = kinds_in("noack.trigger", PolicySettings, "policy")

if TYPE_CHECKING:
    AnyController = ControllerSettings
    AnyDisturbance = DisturbanceSettings
    AnyObserver = ObserverSettings
    AnyPlant = PlantSettings
    AnyTrigger = PolicySettings
else:
    AnyController = union_of(CONTROLLERS, default="linear")
    AnyDisturbance = union_of(DISTURBANCES)
    AnyObserver = union_of(OBSERVERS)
    AnyPlant = union_of(PLANTS, default="linear")
    AnyTrigger = union_of(POLICIES, "policy", default="decaying")
    for _settings in POLICIES.values():
        if not _settings.__pydantic_fields_complete__:  # a policy that combines others
            _settings.model_rebuild(_types_namespace={"AnyTrigger": AnyTrigger})
