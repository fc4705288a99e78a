"""SIGINT and SIGTERM as a flag that is looked at, so that nothing is torn in the middle."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from noack.errors import ExitStatus


class Signals:
    """Turns SIGINT and SIGTERM into a flag; a loop ends at its next look, nothing is torn."""

    def __init__(self) -> None:
        self.received: int | None = None

    @contextmanager
    def handled(self) -> Iterator["Signals"]:
        """Handle the signals while the context lasts."""
        before = {number: signal.signal(number, self._note) for number in _ENDING}
        try:
            yield self
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _note(self, number: int, _frame: FrameType | None) -> None:
        if self.received is not None:  # asked twice: the person means it
            raise SystemExit(self.status)
        self.received = number

    @property
    def status(self) -> ExitStatus:
        """Exit status that tells of the signal, or OK."""
        return _ENDING.get(self.received or 0, ExitStatus.OK)


_ENDING = {
    signal.SIGINT.value: ExitStatus.INTERRUPTED,
    signal.SIGTERM.value: ExitStatus.TERMINATED,
}
