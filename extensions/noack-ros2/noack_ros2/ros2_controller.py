"""A controller that is a node of ROS 2: it receives x_c at each tick and answers with u.

The stamp of a question is the time of the tick; the answer has the same stamp. The question at time
0 is sent before the run, until the node answers.
"""

from typing import Literal

import numpy as np

from noack.extend import (
    NS_PER_S,
    CallerError,
    ControlFailedError,
    ControllerSettings,
    ControlModel,
    Vector,
    entry_names,
)
from noack_ros2.ros2_messages import Entries
from noack_ros2.ros2_peer import Ros2Peer, Ros2Settings, Topic


class Ros2ControllerSettings(Ros2Settings, ControllerSettings):
    """A node of ROS 2, which is asked at each tick; a replay takes its inputs from the record."""

    kind: Literal["ros2"]
    topic: Topic = "/noack/controller"
    """Namespace of the topics: the node receives TOPIC/state and sends TOPIC/input."""

    def law(self, model: ControlModel) -> "Ros2Law":
        return Ros2Law(self, model)


class Ros2Law(Ros2Peer):
    """The node."""

    def __init__(self, settings: Ros2ControllerSettings, model: ControlModel) -> None:
        n, m = model.B.shape
        self._names = entry_names("x", n)
        topics = f"{settings.topic}/state", f"{settings.topic}/input"
        super().__init__(settings, "controller", topics, Entries(0, self._names, np.zeros(n)), m)
        self.about = f"a node of ROS 2 at {settings.router}, {topics[0]} → {topics[1]}"

    def update(self, t_s: float, x: Vector) -> None:
        """The node receives x_c alone."""

    def input(self, t_s: float, x_c: Vector, setpoint: tuple[Vector, Vector] | None) -> Vector:
        try:
            u = self.ask(Entries(round(t_s * NS_PER_S), self._names, x_c))
        except (CallerError, ValueError) as error:
            raise ControlFailedError(str(error)) from None
        if not np.isfinite(u).all():
            raise ControlFailedError(f'controller.kind = "ros2": the answer is {u.tolist()}')
        return u
