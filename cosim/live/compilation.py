"""Compiles, before a run with many loops, what its processes would otherwise do in plain Python."""

from collections.abc import Collection

from controller_node.controller_arrays import CONTROLLER_FLEET
from plant_server.plant_arrays import PLANT_FLEET
from sensor_node.sensor_arrays import SENSOR_FLEET

from noack.config.scenario import Scenario
from noack.runtime.fleet.fleet_choice import prepare

_FLEETS = {"plant": PLANT_FLEET, "sensor": SENSOR_FLEET, "controller": CONTROLLER_FLEET}


def compile_for(run: Scenario, spawn: Collection[str]) -> None:
    """Compile what the processes to ``spawn`` need, unless it is in the cache or the loops are few.

    The start barrier has a time limit, so they do not compile it themselves.
    """
    prepare([(name, role) for name, role in _FLEETS.items() if name in spawn], run)
