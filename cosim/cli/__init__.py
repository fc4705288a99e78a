"""The command line ``noack``: one file per command in :mod:`cosim.cli.commands`."""

import os
import signal

_usual = signal.getsignal(signal.SIGINT)
_replaced = _usual is signal.default_int_handler
if _replaced:
    try:
        # Ctrl-C during the imports: exit status 130, no traceback.
        signal.signal(signal.SIGINT, lambda *_: os._exit(130))
    except ValueError:  # imported by another thread than the main one
        _replaced = False

from cosim.cli.command import app, find_scenario, main, register_commands  # noqa: E402

register_commands()
if _replaced:
    signal.signal(signal.SIGINT, _usual)

__all__ = ["app", "find_scenario", "main"]
