"""The command line ``noack``: one file per command in :mod:`cosim.cli.commands`."""

import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cosim.cli.command import app, find_scenario
else:

    def __getattr__(name: str) -> Any:
        """Import the program with all its commands when a name of it is first used (PEP 562)."""
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from cosim.cli import command

        command.register_commands()
        return getattr(command, name)


__all__ = ["app", "find_scenario", "main"]
_LIVE = ("run", "demo", "record")


def main() -> None:
    """Entry point."""
    from contextlib import suppress

    from noack.runtime.signals import stoppable_imports

    words = sys.argv[1:]
    with stoppable_imports():
        server = None
        if sys.platform == "linux" and words[:1] and words[0] in _LIVE and "--help" not in words:
            from cosim.live.fork_server import ForkServer

            with suppress(OSError):  # the command reports it
                server = ForkServer()  # it imports while this process does
        from cosim.cli.command import register_commands, run_program

        register_commands(*words[:1])
        run_program(server)  # a command handles signals itself
