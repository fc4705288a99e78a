"""SIGINT, SIGTERM and SIGHUP as a flag that is looked at, so that nothing is torn in the middle."""

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from noack.core.errors import ExitStatus

_ECHO_NS = 500_000_000
"""What started a process may pass a signal on that its group had already."""


class Signals:
    """Turns signals into a flag; a loop ends at its next look, nothing is torn."""

    def __init__(self) -> None:
        self.received: int | None = None
        self._received_ns = 0

    @contextmanager
    def handled(self) -> Iterator["Signals"]:
        """Handle the signals while the context lasts; nohup is respected."""
        parse_message = set(_ENDING)
        if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:
            parse_message.remove(signal.SIGHUP)
        before = {number: signal.signal(number, self._note) for number in parse_message}
        try:
            yield self
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _note(self, number: int, _frame: FrameType | None) -> None:
        now_ns = time.monotonic_ns()
        if self.received is None:
            self.received, self._received_ns = number, now_ns
        elif now_ns - self._received_ns > _ECHO_NS:  # asked twice: the person means it
            raise SystemExit(self.status)

    @property
    def status(self) -> ExitStatus:
        """Exit status that tells of the signal, or OK."""
        return _ENDING.get(self.received or 0, ExitStatus.OK)


_ENDING = {
    signal.SIGINT.value: ExitStatus.INTERRUPTED,
    signal.SIGTERM.value: ExitStatus.TERMINATED,
    signal.SIGHUP.value: ExitStatus.TERMINATED,
}
