"""Machines that make one step at a time, for tests, and what tests ask of a machine."""

from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeVar

import numpy as np

from controller_node.controller import Controller, controllers_of
from noack.core.core_library import core, ffi
from noack.machines.loop_machines import LoopMachines
from noack.protocol.roles import Notice, Output, Record
from noack.protocol.wire_format import Flow, Message
from noack.scenario.parameter_changes import ParameterChange
from noack.scenario.scenario import Scenario
from plant_server.plant import Plant, plants_of
from sensor_node.sensor import Sensor, sensors_of

T = TypeVar("T")


class Machine(Protocol[T]):
    """One process of the loop, without its input and output; T is what it receives and sends."""

    def handle(self, message: T, now_ns: int) -> Sequence[T | Record | Notice]:
        """Take a message that arrived at simulated time ``now_ns``."""
        ...

    def on_timer(self, now_ns: int) -> Sequence[T | Record | Notice]:
        """Do the work due at :meth:`next_deadline_ns`; ``now_ns`` may be later than that."""
        ...

    def next_deadline_ns(self) -> int | None:
        """When :meth:`on_timer` is due next; None if no timer is set."""
        ...


class SteppedMachines(LoopMachines):
    """Machines to which a test gives one input at a time, instead of a driver in C."""

    def handle(self, message: Message, now_ns: int) -> Sequence[Output]:
        """Process a message that its machine receives; return what the machine does."""
        given = ffi.new("noack_message *", {
            "flow": message.flow, "sequence": message.sequence, "t_ns": message.t_ns,
            "entries": len(message.vector), "loop": message.loop,
            "vector": message.vector.tolist(),
        })  # fmt: skip
        return self._outputs(lambda: int(core.noack_process_handle(self.core, given, now_ns)))

    def on_timer(self, now_ns: int) -> Sequence[Output]:
        """Do the one tick that is due; return what the machine does."""
        if self.next_deadline_ns() is None:
            return ()
        return self._outputs(lambda: int(core.noack_process_tick(self.core, now_ns)))

    def _outputs(self, step: Callable[[], int]) -> Sequence[Output]:
        outputs: list[Output] = []
        while (question := step()) != core.NOACK_DONE:
            if question != core.NOACK_ROWS_FULL:
                self.raise_failure()
            outputs += self._taken()
        if self.core.output.sends:
            outputs.insert(0, message_of(self.core.output.message))
        return [*outputs, *self._taken()]

    def _taken(self) -> list[Output]:
        records = [Record(table, row) for table, rows in self.take_rows() for row in rows.tolist()]
        return [*records, *self.take_notices()]


def message_of(given: Any) -> Message:
    """A ``noack_message`` as a message."""
    vector = np.array(ffi.unpack(given.vector, given.entries), np.float64)
    return Message(Flow(given.flow), given.sequence, given.t_ns, vector, given.loop)


class OneLoop(SteppedMachines):
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


def sensor_of(resolved: Scenario) -> OneLoop:
    """The sensor of a resolved scenario."""
    return OneLoop(sensors_of((resolved,)).parts)


def controller_of(resolved: Scenario) -> OneLoop:
    """The controller of a resolved scenario."""
    return OneLoop(controllers_of((resolved,)).parts)


def machine(part: Plant | Sensor | Controller) -> OneLoop:
    """The machine of one loop."""
    return OneLoop([part])
