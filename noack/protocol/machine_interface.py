"""What a pure machine is: inputs and time in, outputs out; no socket, no clock, no randomness.

The live shells (``noack.runtime``), the simulator and replay drive machines through this interface.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, TypeVar

from noack.protocol.wire_format import Message

GENERATION = 2**40
"""A restarted process numbers from its generation times this on: newer than all before it."""


class Start(NamedTuple):
    """Where a machine takes up its work in a run."""

    generation: int = 0
    """How often its process has been started anew in this run; one that was knows no state."""
    from_ns: int = 0
    """No timer is due before."""

    @property
    def first_number(self) -> int:
        """The first of its sequence numbers, and of the numbers of its inputs."""
        return self.generation * GENERATION

    @property
    def again(self) -> bool:
        """Whether the process was started anew while the run went on."""
        return self.generation > 0


BEGINNING = Start()
"""The run's own start."""


class Record(NamedTuple):
    """A row for the numeric record; ``noack.protocol.record_tables`` documents the tables."""

    table: str
    row: tuple[Any, ...]


RESTART = "restart"
"""Level of the notice of a process that takes another's place."""
FAILED = "failed"
"""Level of the notice of a plant or controller that cannot continue."""


class Notice(NamedTuple):
    """A line for the run's log, such as a violated assumption."""

    t_ns: int
    level: str
    text: str


Output = Message | Record | Notice

T = TypeVar("T")


class Machine(Protocol[T]):
    """One process of the loop, without its input and output; T is what it receives and sends."""

    def handle(self, message: T, now_ns: int) -> Sequence[T | Record | Notice]:
        """Take a message that arrived at simulated time ``now_ns``."""
        ...

    def on_timer(self, now_ns: int) -> Sequence[T | Record | Notice]:
        """Do what was due at :meth:`next_deadline_ns`; ``now_ns`` may be later than that."""
        ...

    def next_deadline_ns(self) -> int | None:
        """When :meth:`on_timer` is due next; None while nothing is."""
        ...
