"""Machines of one loop from their parts, and vectors of their state, for tests."""

from typing import Any

import numpy as np

from controller_node.controller import Controller
from noack.core.core_memory import reals_at
from noack.core.linear_systems import Matrix, Vector
from noack.machines.loop_machines import LoopMachines
from noack.plants.linear import LinearSystem
from plant_server.plant import Plant
from sensor_node.sensor import Sensor


def machine(part: Plant | Sensor | Controller) -> LoopMachines:
    """The machine of one loop."""
    return LoopMachines([part])


def linear_plant(A: Matrix, B: Matrix, x0: Vector, period_ns: int, **settings: Any) -> LoopMachines:
    """A linear plant from x0 on."""
    system = LinearSystem(A, B, x0)
    return machine(Plant(system, B.shape[1], period_ns=period_ns, **settings))


def state_of(machines: LoopMachines, name: str, loop: int = 0) -> Vector:
    """A copy of a vector of a machine's state: x, x_s and x_c have n entries, u has m."""
    own = machines.machines[loop]
    count = own.machine.m if name == "u" else own.machine.n
    return np.array(reals_at(getattr(own, name), count))
