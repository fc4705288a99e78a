"""Ctrl-C while a program is imported, before it has anything to clean up."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from noack.core.errors import ExitStatus


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
