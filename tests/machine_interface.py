"""A machine as tests drive it: inputs and time in, outputs out."""

from collections.abc import Sequence
from typing import Protocol, TypeVar

from noack.protocol.machine_interface import Notice, Record

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
