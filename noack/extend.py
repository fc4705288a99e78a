"""What extensions build on: base classes of kinds, types of values, checks and errors.

A module of kinds imports from here alone. What runs, records and certificates need is in ``noack``
itself: a module that uses it as well as kinds imports it within functions, because kinds are read
while noack is loaded. ``docs/extending.md`` describes how an extension is made.
"""

from noack.controllers.controller_settings import ControlFailedError as ControlFailedError
from noack.controllers.controller_settings import ControlLaw as ControlLaw
from noack.controllers.controller_settings import ControllerSettings as ControllerSettings
from noack.controllers.controller_settings import ControlModel as ControlModel
from noack.core.clock import NS_PER_S as NS_PER_S
from noack.core.errors import CallerError as CallerError
from noack.core.errors import MachineError as MachineError
from noack.core.errors import NoackError as NoackError
from noack.core.errors import one_line as one_line
from noack.core.errors import shortened as shortened
from noack.core.errors import why as why
from noack.core.file_access import new_file as new_file
from noack.core.linear_systems import Matrix as Matrix
from noack.core.linear_systems import Vector as Vector
from noack.core.periods import exact_ns as exact_ns
from noack.core.periods import nearest_ns as nearest_ns
from noack.disturbances.disturbance_settings import DisturbanceSettings as DisturbanceSettings
from noack.disturbances.disturbance_settings import SignalSource as SignalSource
from noack.plants.plant_settings import EquationSettings as EquationSettings
from noack.plants.plant_settings import Names as Names
from noack.plants.plant_settings import PlantEquations as PlantEquations
from noack.plants.plant_settings import PlantOutline as PlantOutline
from noack.plants.plant_settings import PlantSettings as PlantSettings
from noack.plants.plant_settings import PlantStart as PlantStart
from noack.plants.plant_settings import PlantSystem as PlantSystem
from noack.plants.plant_settings import SystemFailedError as SystemFailedError
from noack.plants.plant_settings import cos as cos
from noack.plants.plant_settings import sin as sin
from noack.plants.plant_settings import sqrt as sqrt
from noack.protocol.record_tables import COMMON as COMMON
from noack.protocol.record_tables import CONTROLLER_DELIVERY as CONTROLLER_DELIVERY
from noack.protocol.record_tables import OWNER as OWNER
from noack.protocol.record_tables import PLANT_STEP as PLANT_STEP
from noack.protocol.record_tables import SENSOR_MEASUREMENT as SENSOR_MEASUREMENT
from noack.protocol.record_tables import TABLES as TABLES
from noack.protocol.record_tables import entry_names as entry_names
from noack.protocol.roles import External as External
from noack.protocol.wire_format import MAX_DIMENSION as MAX_DIMENSION
from noack.settings.named_file import NamedFile as NamedFile
from noack.settings.section import NonNegative as NonNegative
from noack.settings.section import Positive as Positive
from noack.settings.section import Probability as Probability
from noack.settings.section import ScenarioSection as ScenarioSection
from noack.settings.section import Seed as Seed
from noack.settings.section import Table as Table
from noack.settings.user_files import FileSettings as FileSettings
from noack.settings.user_files import checked_path as checked_path
from noack.settings.user_files import real_vector as real_vector
from noack.settings.values import MatrixRows as MatrixRows
from noack.settings.values import RateHz as RateHz
from noack.settings.values import Row as Row
from noack.settings.values import require_length as require_length
from noack.settings.values import require_shape as require_shape
from noack.trigger_policies.policy_settings import ModelMatrices as ModelMatrices
from noack.trigger_policies.policy_settings import PolicySettings as PolicySettings
