"""The compiled machine of a loop for its replay, if it has one and its code is on this computer."""

from collections.abc import Mapping

from controller_node.controller_arrays import CONTROLLER_FLEET
from plant_server.plant_arrays import PLANT_FLEET
from sensor_node.sensor_arrays import SENSOR_FLEET

from noack.config.fleet_layout import FleetRole
from noack.config.scenario import Scenario
from noack.core.errors import CallerError
from noack.protocol.datagram_seal import KEY_BYTES
from noack.runtime.fleet.compiled_driver import kept_replay
from noack.runtime.fleet.compiled_fleet import CompiledFleet
from noack.runtime.fleet.fleet_replay import FleetReplay

_ROLES: Mapping[str, FleetRole] = {
    "plant": PLANT_FLEET,
    "sensor": SENSOR_FLEET,
    "controller": CONTROLLER_FLEET,
}
LEAST_STEPS = 2000
"""The replay of a shorter run takes less time than loading the code."""


def compiled_machine(role: str, scenario: Scenario) -> FleetReplay | None:
    """Return the new machine of a role of one loop; None if the single machine is to be used."""
    found = _ROLES.get(role)
    if found is None or scenario.loops is not None or scenario.changes:
        return None
    code = kept_replay(found)
    if code is None:
        return None
    try:
        parts = found.parts_of([scenario])
    except CallerError:
        return None
    if parts is None:
        return None
    fleet = CompiledFleet(role, found, parts, scenario, [scenario], 0, bytes(KEY_BYTES))
    return FleetReplay(fleet, code)
