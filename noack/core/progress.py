"""How work reports its progress."""

from typing import Protocol


class Progress(Protocol):
    """Called with what is done and with all there is to do, in the same unit; or with the share done."""

    def __call__(self, done: float, total: float = 1.0, /) -> None:
        """Report it."""


def no_progress(_done: float, _total: float = 1.0, /) -> None:
    """Report nothing."""
