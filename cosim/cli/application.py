"""The program ``noack``: all commands, and the one line that it prints of a mistake or an error.

The commands are in :mod:`cosim.cli.commands`, and in extensions (entry points ``noack.commands``).
"""

import re
import sys
from collections.abc import Sequence
from importlib import metadata
from itertools import pairwise
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Option
from typer.core import TyperGroup
from typer.main import get_command_name, get_group

from cosim.cli.options import PANELS, examples
from cosim.live.monitoring.progress_lines import lines_of_command
from netem.core.command_line import StopRequestError, report_failure, stop_requests_raised, why_not_written
from netem.core.errors import CallerError, ExitStatus, NoackError, plain_mistake, printable, why
from netem.core.extension_points import missing_extension, parts
from netem.core.system_processes import exhausted_limit

if TYPE_CHECKING:
    from typer._click.core import Command, Context

NAME = "noack"


class Program(TyperGroup):
    """All commands. What a command returns is the exit status; a mistake or an error is one line."""

    _words: Sequence[str] = ()

    def list_commands(self, ctx: "Context") -> list[str]:
        """Return the names of the commands by panel, those of extensions' own panels last."""

        def position(name: str) -> int:
            panel = getattr(self.commands[name], "rich_help_panel", None)
            return PANELS.index(panel) if panel in PANELS else len(PANELS)

        return sorted(self.commands, key=position)

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,
        windows_expand_args: bool = True,
        **extra: Any,
    ) -> Any:
        """Run the program; the arguments are those of :class:`typer.core.TyperGroup`."""
        words = self._words = list(sys.argv[1:] if args is None else args)
        try:
            _refuse_empty(words)
            with lines_of_command():
                status = super().main(words, prog_name, complete_var, False, windows_expand_args, **extra)
        except typer.TyperException as error:
            status = ExitStatus.CALLER
            if line := self._line(error):
                self._report(line, status)
        except OSError as error:  # help is written to a full disk
            status = self._report(f"cannot write: {why(error)}", ExitStatus.FAILED)
        if standalone_mode:
            sys.exit(int(status or 0))
        return status

    def resolve_command(
        self, ctx: "Context", args: list[str]
    ) -> tuple[str | None, "Command | None", list[str]]:
        """Return the command that the words name, and its words; refuse a repeated option."""
        name, command, words = super().resolve_command(ctx, args)
        if command is not None and not ctx.resilient_parsing:  # a completion has unfinished words
            context = command.context_class(command, ctx, name, **command.context_settings)
            _refuse_repeated(command, context, words)
        return name, command, words

    def invoke(self, ctx: "Context") -> int:
        """Run the command of the command line; return its exit status."""
        try:
            with stop_requests_raised():
                status = super().invoke(ctx)
            if sys.stdout is not None:  # closed by the shell: >&-
                sys.stdout.flush()
            return int(status or ExitStatus.OK)
        except KeyboardInterrupt as error:
            stop = error if isinstance(error, StopRequestError) else StopRequestError()
            line = "; ".join([str(stop), *getattr(error, "__notes__", ())])
            return self._report(line, stop.exit_status)
        except NoackError as error:
            return self._report(str(error), error.exit_status)
        except Exception as error:
            reason = exhausted_limit(error) or why_not_written(error)
            if reason is None:
                raise
            return self._report(reason, ExitStatus.FAILED)

    def _report(self, line: str, status: ExitStatus) -> ExitStatus:
        return report_failure(line, status, source=NAME, as_json="--json" in self._words)

    def _line(self, error: typer.TyperException) -> str:
        """Return the mistake in the words as one line; empty if the help has been shown."""
        message = printable(" ".join(error.format_message().split())).rstrip(".")
        if not message:
            return ""
        message = plain_mistake(message[0].lower() + message[1:]).replace("Value error, ", "")
        message = _with_value(message.removeprefix("invalid value: "), self._words)
        if self._words and (missing := missing_extension("noack.commands", self._words[0])):
            return f"{NAME} {self._words[0]}: {missing}"
        name = next((word for word in self._words if not word.startswith("-")), None)
        name = name if name in self.commands else None
        where, command = (f"{name}: ", f"{NAME} {name}") if name else ("", NAME)
        if option := getattr(error, "option_name", None):
            hint = _setting_hint(option, self.commands.get(name or ""))
            if near := getattr(error, "possibilities", None):
                hint = hint or f"did you mean {near[0]}?"
            if hint:
                return f"{where}no such option: {option}; {hint}"
        if message.endswith("?"):
            return f"{where}{message}"
        if name and message.startswith("missing "):
            return f"{where}{message}, e.g. `{examples_of(self.commands[name])[0]}`"
        return f"{where}{message}; see `{command} --help`"


def _setting_hint(option: str, command: "Command | None") -> str:
    """Return what to set instead if the name of an unknown option is that of a scenario's key."""
    from netem.core.toml_file import keys as keys_of
    from noack.scenario.runtime_parameters import SHORT
    from noack.scenario.scenario import Scenario
    from noack.scenario.symbols import SYMBOLS

    if command is None or not any("--set" in parameter.opts for parameter in command.params):
        return ""
    name = option.lstrip("-").replace("-", "_")
    keys = {key: key for key in keys_of(Scenario)}
    keys |= {short: short for short, key in SHORT.items() if key in keys}
    near = [key for key in (name, f"{name}_s", f"{name}.p", f"loss.{name}") if key in keys]
    return f"did you mean --set {near[0]}=...?" if near else SYMBOLS.get(name, "")


def _with_value(message: str, words: Sequence[str]) -> str:
    """Return a message about an option's value with this value: ``--late x: expected ...``."""
    match = re.match(r"invalid value for '(-[-\w]+)'[^:]*: ", message)
    if match is None:
        return message
    option = match[1]
    joined = [word for word in words if word.startswith(f"{option}=")]
    following = [f"{option} {word}" for before, word in pairwise(words) if before == option]
    given = {*joined, *following}
    return f"{given.pop() if len(given) == 1 else option}: {message[match.end() :]}"


def _refuse_empty(words: Sequence[str]) -> None:
    """Raise BadParameter for an argument without a character; as a path it would be ``.``."""
    for before, word in zip(["", *words], words, strict=False):
        option, _, value = word.partition("=")
        if not word and before.startswith("--"):
            raise typer.BadParameter(f"the value of {before} is empty")
        if not word:
            raise typer.BadParameter("an argument is empty")
        if option.startswith("--") and "=" in word and not value:
            raise typer.BadParameter(f"the value of {option} is empty")


def _refuse_repeated(command: "Command", ctx: "Context", words: Sequence[str]) -> None:
    """Raise BadParameter if an option that takes one value is given twice; flags take none."""
    _, _, given = command.make_parser(ctx).parse_args([*words])
    for parameter in given:
        is_single = not getattr(parameter, "is_flag", False) and not getattr(parameter, "multiple", False)
        if parameter.param_type_name == "option" and is_single and given.count(parameter) > 1:
            option = max(parameter.opts, key=len)
            raise typer.BadParameter(f"{option} is given twice; it takes one value", ctx)


def examples_of(command: "Command") -> list[str]:
    """Return the commands of the examples at the end of a help page."""
    return re.findall(rf"^- `({NAME} [^`]*)`", command.epilog or "", re.MULTILINE)


app = typer.Typer(
    name=NAME,
    cls=Program,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    help="A laboratory for event-triggered control over lossy networks without acknowledgements. "
    "The loop runs as real processes over UDP; the network loses at most mansd packets in a row.\n\n"
    "Each command has --help, with examples at the end. A scenario is a TOML file, or the name of a "
    "shipped one.",
    epilog=examples(
        ("noack doctor", "check this machine"),
        ("noack run lane_following", "run the paper's example live"),
        ("noack view", "view the last run"),
        ("noack simulate lane_following", "run it in virtual time, in some seconds"),
        ("noack certify lane_following", "compute guaranteed bounds"),
        ("noack compare A B", "compare two or more runs"),
        ("noack campaign mb_vs_zoh", "run a grid of settings many times"),
        ("noack netem --explain loss 5%", "use the network emulator alone"),
    ),
)


def _print_version(requested: bool) -> None:
    if requested:
        print(f"noack {metadata.version('noack')}")
        raise typer.Exit


@app.callback()
def global_options(
    _: Annotated[
        bool, Option("--version", callback=_print_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Take the options before the command."""


def _add_commands() -> None:
    """Add the commands of all modules that have some, each of a name that no other has."""
    for commands in parts("cosim.cli.commands", "", _commands_in):
        app.add_typer(commands)
    names = {
        get_command_name(info.name or getattr(info.callback, "__name__", ""))
        for group in app.registered_groups
        for info in getattr(group.typer_instance, "registered_commands", ())
    }

    def read(module: ModuleType) -> typer.Typer | None:
        commands = _commands_in(module)
        if commands is None:
            return None
        # An error if typer cannot use a function. Noack's own are built once, when the program runs.
        group = get_group(commands)
        if taken := names & group.commands.keys():
            raise CallerError(f"there is a command {min(taken)} already")
        names.update(group.commands)
        return commands

    for commands in parts(None, "noack.commands", read):
        app.add_typer(commands)


def _commands_in(module: ModuleType) -> typer.Typer | None:
    commands = getattr(module, "app", None)
    return commands if isinstance(commands, typer.Typer) else None


_add_commands()
