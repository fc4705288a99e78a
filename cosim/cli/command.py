"""Declaration of ``noack``'s commands, what they print, and the program that runs them."""

import inspect
import math
import pkgutil
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from copy import copy
from dataclasses import fields, is_dataclass
from functools import wraps
from importlib import import_module
from itertools import groupby, pairwise
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Concatenate, ParamSpec, TypeVar

import typer
from typer import Option
from typer.core import TyperGroup, TyperOption

from cosim.cli import commands
from cosim.cli.pipe_safe_streams import ignore_broken_pipes
from cosim.lazy_modules import lazy_modules
from noack.core.errors import ExitStatus, NoackError, plain_mistake, printable, why
from noack.core.system_processes import exhausted_limit
from noack.runtime.command_line import StopRequestError, report_failure, stop_requests_raised

with lazy_modules():
    from importlib import metadata

    from cosim.live.monitoring import progress
    from cosim.live.processes import fork_server
    from cosim.output import result_tables
    from noack.core import core_library
    from noack.scenario import runtime_parameters, scenario, toml_file

if TYPE_CHECKING:
    from rich.console import Console
    from typer._click.core import Command, Context, Parameter
    from typer._click.formatting import HelpFormatter

NAME = "noack"
_COMPLETION = ("install_completion", "show_completion")


class Program(TyperGroup):
    """All commands; a usage error is printed as one line with a suggestion."""

    _words: Sequence[str] = ()

    def get_params(self, ctx: "Context") -> list["Parameter"]:
        """Return the options before the command; the help hides those of shell completion.

        If the command comes first, none is needed: for their values typer would import pydantic,
        which takes 0.1 s.
        """
        if self._words and not self._words[0].startswith("-"):
            return []
        parameters = super().get_params(ctx)
        for parameter in parameters:
            if isinstance(parameter, TyperOption) and parameter.name in _COMPLETION:
                parameter.hidden = True
        return parameters

    def format_commands(self, ctx: "Context", formatter: "HelpFormatter") -> None:
        """Write the commands, a section for each panel."""
        by_panel = groupby(self.commands.values(), lambda command: getattr(command, "rich_help_panel", ""))
        for panel, group in by_panel:
            with formatter.section(panel):
                formatter.write_dl(
                    [(command.name or "", command.get_short_help_str(200)) for command in group]
                )

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
            status = super().main(
                words or ["--help"], prog_name, complete_var, False, windows_expand_args, **extra
            )
            status = status if words else ExitStatus.CALLER
        except typer.TyperException as error:
            status = ExitStatus.CALLER
            if message := self._line(error, words):
                report_failure(message, status, source=NAME, as_json="--json" in words)
        except OSError as error:  # help is written to a full disk
            text, as_json = f"cannot write: {why(error)}", "--json" in words
            status = report_failure(text, ExitStatus.FAILED, source=NAME, as_json=as_json)
        if standalone_mode:
            sys.exit(int(status or 0))
        return status

    def _line(self, error: typer.TyperException, words: Sequence[str]) -> str:
        """Return the usage error as one line; empty if the help has been shown."""
        message = printable(" ".join(error.format_message().split())).rstrip(".")
        if not message:
            return ""
        message = plain_mistake(message[0].lower() + message[1:]).replace("Value error, ", "")
        message = _with_value(message.removeprefix("invalid value: "), words)
        name = next((word for word in words if word in self.commands), None)
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
    if command is None or not any("--set" in parameter.opts for parameter in command.params):
        return ""
    name = option.lstrip("-").replace("-", "_")
    keys = {key: key for key in toml_file.keys(scenario.Scenario)}
    keys |= {short: short for short, key in runtime_parameters.SHORT.items() if key in keys}
    near = [key for key in (name, f"{name}_s", f"{name}.p", f"loss.{name}") if key in keys]
    return f"did you mean --set {near[0]}=...?" if near else toml_file.SYMBOLS.get(name, "")


def _with_value(message: str, words: Sequence[str]) -> str:
    """Return a message about an option's value with this value: ``--late x: expected ...``."""
    match = re.match(r"invalid value for '(-[-\w]+)'[^:]*: ", message)
    if match is None:
        return message
    option = match[1]
    joined = [word for word in words if word.startswith(f"{option}=")]
    following = [f"{option} {word}" for before, word in pairwise(words) if before == option]
    return f"{(joined + following or [option])[0]}: {message[match.end() :]}"


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


def examples_of(command: "Command") -> list[str]:
    """Return the commands of the examples at the end of a help page."""
    lines = (command.epilog or "").splitlines()
    commands = (line.strip().partition("   ")[0] for line in lines)
    return [line for line in commands if line.startswith(f"{NAME} ")]


_TOUR = (
    ("noack doctor", "check this machine"),
    ("noack run lane_following", "run the paper's example live"),
    ("noack view", "view the last run"),
    ("noack simulate lane_following", "run it in virtual time, in some seconds"),
    ("noack certify lane_following", "compute guaranteed bounds"),
    ("noack compare A B", "compare two or more runs"),
    ("noack campaign mb_vs_zoh", "run a grid of settings many times"),
    ("noack netem --explain loss 5%", "use the network emulator alone"),
)
"""A first session: commands and their descriptions."""
_MOST_COLUMNS = 78
_SECTION = re.compile(r"\n\n(Options|Examples):\n")
_ARGUMENT = re.compile(r"^    (\w+): (.*(?:\n {8}.*)*)", re.MULTILINE)
"""An option and its help, in a docstring."""

RUNS, THEORY, CAMPAIGNS = "Runs", "Theory", "Campaigns"
MEASURING = "Real networks"
FILES = "Scenario files and this machine"
PROCESSES = "One terminal per process"
PANELS = (RUNS, THEORY, CAMPAIGNS, MEASURING, FILES, PROCESSES)
"""The panels of the help, in order."""

P = ParamSpec("P")
Result = TypeVar("Result")
_help_positions: dict[object, tuple[int, int]] = {}
"""By command function: panel, and place in the panel."""
durations: dict[str, str] = {}
"""By command: how long it takes."""


def _columns(rows: Iterable[tuple[str, str]]) -> list[str]:
    """Return commands and their descriptions as lines, at most 78 columns wide."""
    rows = list(rows)
    width = max(len(command) for command, _ in rows)
    wide = width + max(len(description) for _, description in rows) + len("     ") > _MOST_COLUMNS
    lines: list[str] = []
    for command, description in rows:
        gap = f"\n{'':6}" if wide else " " * (width - len(command) + 3)
        lines.append(f"  {command}{gap if description else ''}{description}")
    return lines


app = typer.Typer(
    name=NAME,
    cls=Program,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # importing rich takes 0.1 s
    # \b keeps the lines of a paragraph as they are.
    help="\n".join(
        [
            "A laboratory for event-triggered control over lossy networks without acknowledgements. "
            "The loop runs as real processes over UDP; the network loses at most M − 1 consecutive "
            "packets.",
            "",
            "\b",
            *_columns(_TOUR),
            "",
            "Each command has --help, with examples at the end. A scenario is a TOML file, or the name "
            "of a shipped one. `noack --install-completion` installs shell completion.",
        ]
    ),
)


def _version(requested: bool) -> None:
    if requested:
        print(f"noack {metadata.version('noack')}")
        raise typer.Exit


@app.callback()
def global_options(
    _: Annotated[
        bool, Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Take the options before the command."""


def command(
    panel: str, position: int, *, takes: str = "", on_linux: bool = False, **settings: Any
) -> Callable[[Callable[..., int | None]], Callable[..., None]]:
    """Register a command. Its result is the exit status; an error or Ctrl-C is printed as one line.

    The fields of a parameter that is a dataclass are options. The help of an option is under
    ``Options:`` in the docstring of the command or the dataclass, unless this module declares it;
    the examples at the end of the command's help are under ``Examples:``.

    Args:
        panel: panel of the help, one of :data:`PANELS`.
        position: sort key within the panel, ascending.
        takes: how long it takes, for its help and the manual, unless it is instant.
        on_linux: Linux only: elsewhere an error.
        settings: keyword arguments of :meth:`typer.Typer.command`.
    """

    def register(function: Callable[..., int | None]) -> Callable[..., None]:
        text, examples = _describe_options(function)
        text += f"\n\nTakes {takes}." if takes else ""
        grouped = _with_option_groups(function)

        @wraps(grouped)
        def reported(**arguments: Any) -> None:
            def call() -> int | None:
                if on_linux:
                    core_library.require_live_runs()
                return grouped(**arguments)

            raise typer.Exit(_status_of(call, as_json=bool(arguments.get("json"))))

        _help_positions[reported] = PANELS.index(panel), position
        if takes:
            durations[settings.get("name", function.__name__)] = takes
        epilog = "\n".join(["\b", "Examples:", *_columns(examples)]) if examples else None
        registered: Callable[..., None] = app.command(
            rich_help_panel=panel, epilog=epilog, help=text, **settings
        )(reported)
        return registered

    return register


def _with_option_groups(function: Callable[..., int | None]) -> Callable[..., int | None]:
    """Return a command whose options are the fields of its parameters that are dataclasses."""
    parameters, groups = _parameters(function)

    @wraps(function)
    def grouped(**options: object) -> int | None:
        for name, group in groups.items():
            options[name] = group(**{field.name: options.pop(field.name) for field in fields(group)})
        return function(**options)

    grouped.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    grouped.__annotations__ = {option.name: option.annotation for option in parameters}
    return grouped


def _status_of(call: Callable[[], int | None], *, as_json: bool) -> int:
    """Return the exit status of a command; print an error or Ctrl-C as one line."""
    try:
        with stop_requests_raised():
            status = call() or ExitStatus.OK
        if sys.stdout is not None:  # closed by the shell: >&-
            sys.stdout.flush()
        return int(status)
    except KeyboardInterrupt as error:
        stop = error if isinstance(error, StopRequestError) else StopRequestError()
        line, status = "; ".join([str(stop), *getattr(error, "__notes__", ())]), stop.exit_status
    except NoackError as error:
        line, status = str(error), error.exit_status
    except Exception as error:
        reason = exhausted_limit(error) or _why_not_written(error)
        if reason is None:
            raise
        line, status = reason, ExitStatus.FAILED
    return int(report_failure(line, status, source=NAME, as_json=as_json))


def _describe_options(described: Any) -> tuple[str, list[tuple[str, str]]]:
    """Give options the help of the docstring; return the text before it, and the examples."""
    text, *sections = _SECTION.split(inspect.cleandoc(described.__doc__ or ""))
    section = dict(zip(sections[::2], sections[1::2], strict=True))
    for name, words in _ARGUMENT.findall(section.get("Options", "")):
        annotation = described.__annotations__[name]
        metadata = getattr(annotation, "__metadata__", ())
        option = copy(metadata[0]) if metadata else Option()
        option.help = " ".join(words.split())
        option_type = annotation.__origin__ if metadata else annotation
        described.__annotations__[name] = Annotated[option_type, option]
    lines = (line.strip().partition("   ") for line in section.get("Examples", "").splitlines())
    return text, [(example, description) for example, _, description in lines]


def _parameters(function: Callable[..., int | None]) -> tuple[list[inspect.Parameter], dict[str, type[Any]]]:
    """Return the options of a command, and the dataclasses that group them, by parameter."""
    parameters, groups = [], {}
    for parameter in inspect.signature(function).parameters.values():
        members, types = [parameter], function.__annotations__
        if is_dataclass(group := parameter.annotation):
            assert isinstance(group, type)
            groups[parameter.name], types = group, {}
            members = [*inspect.signature(group).parameters.values()]
            for base in group.__mro__[-2::-1]:
                _describe_options(base)
                types |= vars(base).get("__annotations__", {})
        parameters += [
            option.replace(kind=option.KEYWORD_ONLY, annotation=types[option.name]) for option in members
        ]
    return parameters, groups


def _why_not_written(error: Exception) -> str | None:
    """Return why standard output cannot be written; None if this is another error."""
    if not isinstance(error, OSError):
        return None
    try:
        folder_exists = Path.cwd().is_dir()
    except OSError:
        folder_exists = False
    return f"cannot write: {why(error)}" if folder_exists else "the current folder was deleted"


def register_commands(name: str = "") -> None:
    """Import the module that declares a command; otherwise import all, sorted for the help.

    It is found by its source, since importing all of them takes 0.05 s.
    """
    folder = Path(commands.__path__[0])
    modules = [module.name for module in pkgutil.iter_modules([str(folder)])]
    texts = {module: (folder / f"{module}.py").read_text("utf-8") for module in modules}
    declarations = f"\ndef {name}(", f'\n_join("{name}",'
    declaring = [module for module in modules if any(line in texts[module] for line in declarations)]
    for module in declaring or modules:
        import_module(f"{commands.__name__}.{module}")
    app.registered_commands.sort(key=lambda command: _help_positions[command.callback])


def console() -> "Console":
    """Return a console on standard output."""
    # importing rich takes 0.05 s
    from rich.console import Console

    return Console()


def status(activity: str) -> "AbstractContextManager[Callable[[str], None]]":
    """Show within the context what a command is doing; the result replaces it."""
    return progress.activity(activity)


def write_tables(tables: "Iterable[result_tables.ResultTable]", folder: Path | None, *, json: bool) -> None:
    """Write the tables of ``--tables``, if it is given; print the paths, unless with ``--json``."""
    if folder is not None:
        paths = result_tables.save_tables(tables, folder)
        if not json:
            print(*paths, sep="\n")


def show_with_files(
    json: bool,
    document: dict[str, object],
    files: Iterable[Path],
    show_text: "Callable[[Console, Result], object]",
    result: Result,
) -> None:
    """Print a result as :func:`show` does, with the paths of the files that were written."""
    names = [str(file) for file in files]
    show(json, lambda: document | {"files": names}, show_text, result)
    if not json:
        print(*names, sep="\n")


def print_lines(json: bool, document: object, *lines: object) -> None:
    """Print a result that is one line or few: the document of ``--json``, or the lines."""
    if json:
        print_json(document)
    else:
        print(*lines, sep="\n")


def show(
    json: bool,
    document: Callable[[], object],
    show_text: "Callable[Concatenate[Console, P], object]",
    *arguments: P.args,
    **keywords: P.kwargs,
) -> None:
    """Print a result: the document of ``--json``, or ``show_text(console, *arguments, **keywords)``."""
    if json:
        print_json(document())
    else:
        show_text(console(), *arguments, **keywords)


def print_json(document: object) -> None:
    """Print the document of ``--json``; a number that is not finite becomes null."""
    print(dumps(_finite(document), indent=2, allow_nan=False))


def _finite(value: object) -> object:
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def run_program(server: "fork_server.ForkServer | None" = None) -> None:
    """Run the command of the command line; a live run uses the server."""
    if sys.argv[1:2] != ["netem"]:  # the emulator ends when its output is closed
        ignore_broken_pipes()
    app(prog_name=NAME, obj=server)
