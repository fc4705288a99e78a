"""Machines of one loop from their parts, and vectors of their state, for tests."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from controller_node.controller import Controller, controllers_of
from noack.config.parameter_changes import ParameterChange
from noack.config.scenario import Scenario
from noack.core.core_memory import reals_at
from noack.core.linear_systems import Matrix, Vector
from noack.machines.loop_machines import LoopMachines
from noack.plants.linear import LinearSystem
from noack.protocol.machine_interface import BEGINNING, Notice, Output, Record, Start
from noack.protocol.wire_format import Message
from plant_server.plant import Plant, plants_of
from sensor_node.sensor import Sensor, sensors_of


class OneLoop(LoopMachines):
    """The machine of one loop; its rows and log lines are without the number of the loop."""

    def handle(self, message: Message, now_ns: int) -> Sequence[Output]:
        return [_without_loop(output) for output in super().handle(message, now_ns)]

    def on_timer(self, now_ns: int) -> Sequence[Output]:
        return [_without_loop(output) for output in super().on_timer(now_ns)]

    def announce(self, change: ParameterChange, now_ns: int) -> Sequence[Any]:
        return [_without_loop(output) for output in super().announce(change, now_ns)]


def _without_loop(output: Any) -> Any:
    if isinstance(output, Record):
        return Record(output.table, output.row[1:])
    return output._replace(loop=None) if isinstance(output, Notice) else output


def plant_of(resolved: Scenario) -> OneLoop:
    """The plant of a resolved scenario."""
    return OneLoop(plants_of((resolved,)).parts)


def sensor_of(resolved: Scenario, start: Start = BEGINNING) -> OneLoop:
    """The sensor of a resolved scenario."""
    return OneLoop(sensors_of((resolved,), start=start).parts)


def controller_of(resolved: Scenario, start: Start = BEGINNING) -> OneLoop:
    """The controller of a resolved scenario."""
    return OneLoop(controllers_of((resolved,), start=start).parts)


def machine(part: Plant | Sensor | Controller) -> LoopMachines:
    """The machine of one loop."""
    return OneLoop([part])


def linear_plant(A: Matrix, B: Matrix, x0: Vector, period_ns: int, **settings: Any) -> LoopMachines:
    """A linear plant from x0 on."""
    system = LinearSystem(A, B, x0)
    return machine(Plant(system, B.shape[1], period_ns=period_ns, **settings))


def state_of(machines: LoopMachines, name: str, loop: int = 0) -> Vector:
    """A copy of a vector of a machine's state: x, x_s and x_c have n entries, u has m."""
    own = machines.machines[loop]
    count = own.machine.m if name == "u" else own.machine.n
    return np.array(reals_at(getattr(own, name), count))
