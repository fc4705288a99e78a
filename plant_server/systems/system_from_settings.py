"""From a resolved scenario to its system."""

import numpy as np

from noack.config.plant_systems import (
    CartPoleSettings,
    FmuSettings,
    FourTankSettings,
    PythonSettings,
    QuadrotorSettings,
    VehicleSettings,
)
from noack.config.resolution import loop_of
from noack.config.scenario import Scenario
from noack.core.linear_systems import Matrix
from plant_server.system import PlantSystem
from plant_server.systems.linear_plant import LinearSystem


def prepare(settings: object) -> None:
    """Do what a system takes long for once on a machine: a vehicle's equations are compiled.

    Raises:
        CallerError: what it is made of is not there.
    """
    if isinstance(settings, VehicleSettings):
        settings.require_installed()
        from plant_server.systems import equations

        if not equations.kept(settings.library_model):
            equations.prepare(settings.library_model)


def system_of(resolved: Scenario) -> PlantSystem:
    """Return the system of a resolved scenario's plant, at x(0).

    A linear one whose state is disturbed has w as further inputs, n of them: ẋ = Ax + [B I][u; w].

    Raises:
        CallerError: what the system is made of is not there, or not what the scenario says.
    """
    settings, x0 = resolved.plant.system, np.array(resolved.plant.initial_state)
    # Integrators take time to import and 40 MB, which linear plants need not.
    match settings:
        case CartPoleSettings():
            from plant_server.systems.cart_pole import cart_pole

            return cart_pole(settings, x0)
        case FourTankSettings():
            from plant_server.systems.four_tank import four_tank

            return four_tank(settings, x0)
        case QuadrotorSettings():
            from plant_server.systems.quadrotor_plant import quadrotor

            return quadrotor(settings, x0)
        case VehicleSettings():
            from plant_server.systems.vehicle import vehicle

            return vehicle(settings, x0)
        case FmuSettings():
            from plant_server.systems.fmu import FmuSystem

            return FmuSystem(settings, x0)
        case PythonSettings():
            from plant_server.systems.python_plant import PythonSystem

            return PythonSystem(settings, x0, resolved.model.dimensions[1])
        case _:
            loop = loop_of(resolved)
            B: Matrix = loop.B
            if any(one.at == "state" for one in resolved.plant.disturbances):
                B = np.hstack([B, np.eye(loop.n)])
            return LinearSystem(loop.A, B, x0, step_ns=resolved.timing.plant_period_ns)
