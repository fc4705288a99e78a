"""What extensions build on: base classes of kinds, types of values, checks and errors.

A module of kinds imports from here alone. What runs, records and certificates need is in ``noack``
itself: a module that uses it as well as kinds imports it within functions, because kinds are read
while noack is loaded. ``docs/extending.md`` describes how an extension is made.
"""

from netem.core.clock import NS_PER_S as NS_PER_S
from netem.core.errors import CallerError as CallerError
from netem.core.errors import MachineError as MachineError
from netem.core.errors import NoackError as NoackError
from netem.core.errors import one_line as one_line
from netem.core.errors import shortened as shortened
from netem.core.errors import why as why
from netem.core.file_access import new_file as new_file
from netem.core.named_file import NamedFile as NamedFile
from netem.core.periods import exact_ns as exact_ns
from netem.core.periods import nearest_ns as nearest_ns
from netem.core.settings_section import NonNegative as NonNegative
from netem.core.settings_section import Positive as Positive
from netem.core.settings_section import Probability as Probability
from netem.core.settings_section import ScenarioSection as ScenarioSection
from netem.core.settings_section import Seed as Seed
from netem.core.settings_section import Table as Table
from noack.controllers.controller_settings import ControlFailedError as ControlFailedError
from noack.controllers.controller_settings import ControlLaw as ControlLaw
from noack.controllers.controller_settings import ControllerSettings as ControllerSettings
from noack.controllers.controller_settings import ControlModel as ControlModel
from noack.core.linear_systems import Matrix as Matrix
from noack.core.linear_systems import Vector as Vector
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
