"""A plant or controller that is a node of ROS 2: its settings, and how it is asked."""

import re
from typing import TYPE_CHECKING, Annotated

import numpy as np
from pydantic import AfterValidator, Field

from noack.extend import CallerError, External, Positive, ScenarioSection, Vector
from noack_ros2.ros2_messages import DEFAULT_ROUTER, Entries

if TYPE_CHECKING:
    from noack_ros2.ros2_node import TopicExchange

_AGAIN_S = 0.2
"""Time after which the first question is asked again: the node may start later."""


def _require_topic(text: str) -> str:
    if not re.fullmatch(r"(/[A-Za-z_][A-Za-z0-9_]*)+", text):
        raise ValueError("must be a name of ROS 2 such as /noack/plant")
    return text


Topic = Annotated[str, AfterValidator(_require_topic)]


class Ros2Settings(ScenarioSection):
    """The node's address, and the time that it may take."""

    router: str = DEFAULT_ROUTER
    """Address of the router of ROS 2, as zenoh writes it."""
    listen: bool = False
    """Whether this process is itself the router at this address, to which the node connects."""
    domain: Annotated[int, Field(ge=0, le=232)] = 0
    """The node's ROS_DOMAIN_ID."""
    timeout_s: Positive = 0.5
    """Longest wait for an answer, in wall time."""
    start_timeout_s: Positive = 10.0
    """Longest wait for the first answer, in wall time."""


class Ros2Peer(External):
    """The node, which is asked; connected with the first question, or before.

    Args:
        settings: settings of the plant or controller.
        place: the table of the scenario.
        topics: topics of the questions and of the answers.
        first: content of the first question.
        count: number of values of an answer.
    """

    def __init__(
        self,
        settings: Ros2Settings,
        place: str,
        topics: tuple[str, str],
        first: Entries,
        count: int,
    ) -> None:
        self._settings, self._place, self._topics = settings, place, topics
        self._first, self._count = first, count
        self._exchange: TopicExchange | None = None
        self.first_answer = np.zeros(count)

    def connect(self) -> None:
        """Ask until the node answers.

        Raises:
            CallerError: a package is missing, there is no router, or no valid answer in time.
        """
        if self._exchange is not None:
            return
        # Scenarios without such a part do not wait for zenoh.
        from noack_ros2.ros2_node import Node, TopicExchange

        settings, name = self._settings, self._place.replace(".", "_")
        node = Node(f"noack_{name}", settings.router, settings.domain, listen=settings.listen)
        exchange = TopicExchange(node, *self._topics, self._place)
        try:
            answer = exchange.ask(self._first, self._count, settings.start_timeout_s, again_s=_AGAIN_S)
        except (TimeoutError, ValueError) as error:
            node.close()
            raise CallerError(f'{self._place}.kind = "ros2": {error}') from None
        self._exchange, self.first_answer = exchange, answer.values

    def ask(self, question: Entries) -> Vector:
        """Return the answer, or the recorded one in a replay.

        Raises:
            CallerError: see :meth:`connect`.
            ValueError: there is no valid answer in time; the message is one line.
        """
        if self.recorded is not None:
            return self.recorded
        self.connect()
        assert self._exchange is not None
        try:
            return self._exchange.ask(question, self._count, self._settings.timeout_s).values
        except (TimeoutError, ValueError) as error:
            raise ValueError(f'{self._place}.kind = "ros2": {error}') from None
