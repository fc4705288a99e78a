"""Signals that end a program: a flag that loops poll, an error elsewhere, an exit in the imports.

In the loop of a process no write may be interrupted. A command is interrupted by an error, so that
it cleans up. During the imports an error would be printed from within them, or caught there.
"""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
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
_REASONS = {
    signal.SIGINT.value: "stopped by the user",
    signal.SIGTERM.value: "stopped on request",
    signal.SIGHUP.value: "stopped because the terminal was closed",
}


def stop_reason(number: int) -> str:
    """Return why a program stops after a signal, with the signal's name."""
    return f"{_REASONS[number]} ({signal.Signals(number).name})"


class StopRequestError(KeyboardInterrupt):
    """A signal asks the program to stop: what cleans up after Ctrl-C does so after each of them."""

    def __init__(self, number: int = signal.SIGINT) -> None:
        super().__init__(stop_reason(number))
        self.exit_status = _ENDING[number]


@contextmanager
def stop_requests_raised() -> Iterator[None]:
    """Raise StopRequestError on SIGINT, SIGTERM and SIGHUP while the context lasts.

    Ignored signals stay ignored, and a handler that another program has set is not replaced.
    """
    came_ns: int | None = None

    def stop(number: int, _frame: FrameType | None) -> None:
        nonlocal came_ns
        now_ns = time.monotonic_ns()
        if came_ns is None or now_ns - came_ns > _ECHO_NS:
            came_ns = now_ns
            raise StopRequestError(number)

    with _default_replaced(stop):
        yield


@contextmanager
def stoppable_imports() -> Iterator[None]:
    """End the process with one line and its exit status on a signal, while the context lasts."""
    with _default_replaced(_end_at_once):
        yield


def _end_at_once(number: int, _frame: FrameType | None) -> None:
    with suppress(OSError):  # standard error may be closed or full
        os.write(2, f"noack: {stop_reason(number)}\n".encode())
    os._exit(_ENDING[number])


@contextmanager
def _default_replaced(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    usual = (signal.SIG_DFL, signal.default_int_handler, _end_at_once)
    before = {number: signal.getsignal(number) for number in _ENDING}
    replaced = {number: found for number, found in before.items() if found in usual}
    for number in replaced:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number, found in replaced.items():
            signal.signal(number, found)
