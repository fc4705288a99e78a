"""Entry point of the network emulator, which relays for any UDP program.

::

    python -m netem --listen 127.0.0.1:9000 --to 127.0.0.1:9001 loss 30% mansd 4
    python -m netem shell loss 30% mansd 4 -- COMMAND
"""

import sys
from collections.abc import Sequence
from typing import NoReturn

from netem.core.command_line import stoppable_imports, stoppable_until_exit

with stoppable_imports():
    from netem.core.command_line import Parser, netem_program, report_failure, why_not_written
    from netem.core.errors import CallerError, ExitStatus, NoackError
    from netem.core.standard_streams import guard_streams
    from netem.core.system_processes import exhausted_limit

COMMANDS = ("show", "set", "watch", "shell", "measure")
"""First words that are commands."""


def main(arguments: Sequence[str] | None = None, parser: Parser | None = None) -> int:
    """Run the emulator, a shell, or a command for a running emulator.

    Args:
        arguments: the words of the command line.
        parser: of the emulator's options; by default
            :func:`netem.emulator_options.command_line_parser`.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    command = words[0] if words and words[0] in COMMANDS else None
    if command not in (None, "shell", "measure"):
        from netem.control import emulator_commands  # the relay starts without it

        return emulator_commands.main(words)
    as_json = "--json" in words
    try:
        if command == "shell":
            from netem.shell.shell import run_in_shell  # the relay starts without it

            as_json = "--json" in words[: (*words, "--").index("--")]
            return run_in_shell(words[1:])
        if command == "measure":
            return _measure(words[1:])
        from netem.stand_alone import run_stand_alone

        status = run_stand_alone(words, parser)
        if sys.stdout is not None:  # closed by the shell: >&-
            sys.stdout.flush()
        return status
    except NoackError as error:
        return report_failure(str(error), error.exit_status, source=netem_program(), as_json=as_json)
    except OSError as error:
        reason = exhausted_limit(error) or why_not_written(error) or str(error)
        return report_failure(reason, ExitStatus.FAILED, source=netem_program(), as_json=as_json)


def _measure(words: Sequence[str]) -> ExitStatus:
    try:
        from netem.measurement.measure_command import measure  # the relay starts without it
    except ModuleNotFoundError as error:
        if error.name is None or not error.name.startswith("scipy"):
            raise
        raise CallerError("measure needs scipy: pip install 'noack-netem[measure]'") from None
    return measure(words)


def command() -> NoReturn:
    """Run the command ``noack-netem``."""
    stoppable_until_exit()  # also while parts are imported that only some commands need
    guard_streams(ignore_broken_pipes=False)  # the emulator ends when its output is closed
    sys.exit(main())


if __name__ == "__main__":
    command()
