"""Signals: a flag that loops poll, so that no write is interrupted; Ctrl-C during the imports."""

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from noack.core.errors import ExitStatus

_ECHO_NS = 500_000_000  # a parent may pass on a signal that the process group has received already


class Signals:
    """Turns signals into a flag; a loop ends when it polls the flag."""

    def __init__(self) -> None:
        self.received: int | None = None
        self._received_ns = 0

    @contextmanager
    def handled(self) -> Iterator["Signals"]:
        """Handle the signals while the context lasts; under nohup, SIGHUP stays ignored."""
        handled = set(_ENDING)
        if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:
            handled.remove(signal.SIGHUP)
        before = {number: signal.signal(number, self._note) for number in handled}
        try:
            yield self
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _note(self, number: int, _frame: FrameType | None) -> None:
        now_ns = time.monotonic_ns()
        if self.received is None:
            self.received, self._received_ns = number, now_ns
        elif now_ns - self._received_ns > _ECHO_NS:  # a second request: end at once
            raise SystemExit(self.status)

    @property
    def status(self) -> ExitStatus:
        """Exit status for the received signal, or OK."""
        return _ENDING.get(self.received or 0, ExitStatus.OK)


_ENDING = {
    signal.SIGINT.value: ExitStatus.INTERRUPTED,
    signal.SIGTERM.value: ExitStatus.TERMINATED,
    signal.SIGHUP.value: ExitStatus.TERMINATED,
}


@contextmanager
def quiet_interrupt() -> Iterator[None]:
    """End the process on SIGINT with exit status 130 and no traceback, while the context lasts.

    A ``KeyboardInterrupt`` would be printed from within the imports, or caught there. A handler
    that another program has set is not replaced.
    """
    usual = signal.default_int_handler
    if threading.current_thread() is not threading.main_thread() or (
        signal.getsignal(signal.SIGINT) is not usual
    ):
        yield
        return
    signal.signal(signal.SIGINT, lambda *_: os._exit(ExitStatus.INTERRUPTED))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, usual)


@contextmanager
def exit_on_signals() -> Iterator[None]:
    """Let SIGTERM and SIGHUP raise SystemExit meanwhile, so that temporary files are removed.

    Only the main thread can handle signals; in others this has no effect.
    """

    def leave(number: int, _frame: FrameType | None) -> None:
        raise SystemExit(_ENDING[number])

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = (signal.SIGTERM, signal.SIGHUP)
    before = {
        number: signal.signal(number, leave)
        for number in numbers
        if signal.getsignal(number) == signal.SIG_DFL
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
