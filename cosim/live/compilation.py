"""Compiles, before a run with many loops, what its processes would otherwise do in plain Python."""

from collections.abc import Collection

from controller_node.controller_arrays import CONTROLLER_FLEET
from netem.engine.native_pump import compiled_pump, kept_pump
from noack.config.scenario import Scenario
from noack.core.code_cache import while_compiling
from noack.runtime.command_line import print_to_stderr
from noack.runtime.fleet.fleet_choice import COMPILED_FROM_LOOPS, prepare
from noack.runtime.peer_sockets import has_peer_sockets
from plant_server.plant_arrays import PLANT_FLEET
from sensor_node.sensor_arrays import SENSOR_FLEET

_FLEETS = {"plant": PLANT_FLEET, "sensor": SENSOR_FLEET, "controller": CONTROLLER_FLEET}
_EMULATOR_ABOUT_S = 15.0


def compile_for(run: Scenario, spawn: Collection[str]) -> None:
    """Compile what the processes to ``spawn`` need, unless it is in the cache or the loops are few.

    The start barrier has a time limit, so they do not compile it themselves.
    """
    prepare([(name, role) for name, role in _FLEETS.items() if name in spawn], run)
    loops = sum(section.count for section in run.loops or ())
    if "netem" not in spawn or loops < COMPILED_FROM_LOOPS:
        return
    if has_peer_sockets() and kept_pump() is None:
        about = while_compiling("the emulator", kept=True, about_s=_EMULATOR_ABOUT_S)
        print_to_stderr(f"noack: {about}")
        compiled_pump()
