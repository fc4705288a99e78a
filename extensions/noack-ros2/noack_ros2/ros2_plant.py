"""A plant that is a node of ROS 2: it receives u and answers with x, step by step.

A question is the input from the plant's last step on, stamped with the time of the next step; the
node advances to this time, and answers with the state, with the same stamp. The question at time 0
asks for x(0).
"""

from typing import Literal

import numpy as np

from noack.extend import (
    CallerError,
    Matrix,
    PlantSettings,
    PlantStart,
    SystemFailedError,
    Vector,
    entry_names,
)
from noack_ros2.ros2_messages import Entries
from noack_ros2.ros2_peer import Ros2Peer, Ros2Settings, Topic

_PLACE = "plant.system"
_START_TOLERANCE = 1e-6
"""Relative difference of the node's first state from x(0)."""


class Ros2PlantSettings(Ros2Settings, PlantSettings):
    """A node of ROS 2, which is asked in each step; a replay takes its states from the record."""

    kind: Literal["ros2"]
    topic: Topic = "/noack/plant"
    """Namespace of the topics: the node receives TOPIC/input and sends TOPIC/state."""

    def linearisation(self) -> tuple[Matrix, Matrix] | None:
        raise CallerError(f'{_PLACE}.kind = "ros2": it has no known linearisation')

    def system(self, start: PlantStart) -> "Ros2System":
        return Ros2System(self, start)


class Ros2System(Ros2Peer):
    """The node, at x(0); z is empty."""

    def __init__(self, settings: Ros2PlantSettings, start: PlantStart) -> None:
        self._names = entry_names("u", start.B.shape[1])
        first = Entries(0, self._names, np.zeros(len(self._names)))
        topics = f"{settings.topic}/input", f"{settings.topic}/state"
        super().__init__(settings, _PLACE, topics, first, len(start.x0))
        self.about = f"a node of ROS 2 at {settings.router}, {topics[0]} → {topics[1]}"
        self._x0 = start.x0
        self.x, self.z = start.x0.copy(), np.zeros(0)

    def connect(self) -> None:
        super().connect()
        first_x, x0 = self.first_answer, self._x0
        if not np.all(np.abs(first_x - x0) <= _START_TOLERANCE * (np.abs(x0) + 1.0)):
            raise CallerError(
                f'{_PLACE}.kind = "ros2": x is {first_x.tolist()} at the start; '
                f"plant.initial_state is {x0.tolist()}"
            )

    def advance(self, u: Vector, t_ns: int, dt_ns: int) -> None:
        try:
            self.x = self.ask(Entries(t_ns + dt_ns, self._names, u))
        except (CallerError, ValueError) as error:
            raise SystemFailedError(str(error)) from None
