"""The console script ``noack``: quiet if it is stopped by Ctrl-C while the program is imported.

Python would print a traceback. From :func:`cosim.cli.main` on, one line says what stopped it.
"""

import signal

if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # it is ignored after a shell's &
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def main() -> None:
    """Import the program, and run it."""
    from cosim.cli import main as program  # slow to import

    program()
