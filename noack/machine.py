"""What a pure machine is: inputs and time in, outputs out; no socket, no clock, no randomness.

The live shells (``noack.io``), the simulator and replay drive machines through this interface.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, TypeVar

from noack.wire import Message


class Record(NamedTuple):
    """A row for the numeric record; ``noack.records`` documents the tables."""

    table: str
    row: tuple[Any, ...]


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
