"""The command line ``noack``; its commands are in :mod:`cosim.cli.commands`.

:func:`main` lets Ctrl-C end the process at once before it imports anything: a shell's status is 130.
"""

import signal

TYPE_CHECKING = False  # importing typing takes longer than all else before the handler
if TYPE_CHECKING:
    from cosim.cli.command import app
else:

    def __getattr__(name: str) -> object:
        """Import the program with all its commands when a name of it is first used (PEP 562)."""
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from cosim.cli import command  # `main` imports nothing before its handler

        command.register_commands()
        return getattr(command, name)


__all__ = ["app", "main"]


def main() -> None:
    """Entry point."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from cosim.cli import entry_point  # Ctrl-C would print a traceback from within these imports

    entry_point.run()
