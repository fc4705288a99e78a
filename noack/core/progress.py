"""How work reports its progress."""

from typing import Protocol


class Progress(Protocol):
    """Called with what is done and with all there is to do, in the same unit; or with the share done."""

    def __call__(self, done: float, total: float = 1.0, /) -> None:
        """Report it."""


def part_of(progress: Progress, begin: float, end: float) -> Progress:
    """Return the progress of one part of the work, which is from share ``begin`` to ``end`` of it."""

    def report(done: float, total: float = 1.0, /) -> None:
        progress(begin + (end - begin) * done / total)

    return report


def no_progress(_done: float, _total: float = 1.0, /) -> None:
    """Report nothing."""
