"""The command line ``noack``; its commands are in :mod:`cosim.cli.commands`.

:func:`main` lets Ctrl-C end the process at once before it imports anything: a shell's status is 130.
"""

import signal


def main() -> None:
    """Entry point."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from cosim.cli import entry_point  # Ctrl-C would print a traceback from within these imports

    entry_point.run()
