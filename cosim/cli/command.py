"""Declaration of ``noack``'s commands, their shared functions, and the entry point."""

import math
import pkgutil
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, ExitStack
from copy import copy
from enum import StrEnum
from functools import wraps
from importlib import import_module
from inspect import cleandoc
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Concatenate, ParamSpec

import typer
from typer import Argument, Option

from cosim.cli import commands, completion
from cosim.cli.program import NAME, Program, ignore_broken_pipes
from cosim.output.figure_format import FigureFormat
from cosim.record.run_directory import DEFAULT_RUNS as DEFAULT_RUNS
from cosim.shipped_files import find_shipped
from noack.core.errors import ExitStatus, NoackError, why
from noack.core.process_limits import cores as cores
from noack.core.process_limits import exhausted_limit
from noack.runtime.command_line import LogFormat as LogFormat
from noack.runtime.command_line import StopRequestError, failed, log_format, stop_requests_raised

if TYPE_CHECKING:
    from rich.console import Console
    from rich.status import Status

    from cosim.live.fork_server import ForkServer
    from cosim.output.result_tables import ResultTable
    from noack.config.scenario import Scenario

_TOUR = (
    ("noack doctor", "check this machine"),
    ("noack run lane_following", "run the paper's example live"),
    ("noack view", "view the last run"),
    ("noack simulate lane_following", "run it in virtual time, in a second"),
    ("noack certify lane_following", "compute guaranteed bounds"),
    ("noack fidelity", "compare the last run with the ideal loop"),
    ("noack compare A B", "compare two or more runs"),
    ("noack campaign mb_vs_zoh", "run a grid of settings many times"),
    ("noack netem --explain loss 5%", "use the network emulator alone"),
)
"""A first session: commands and their descriptions."""
_MOST_COLUMNS = 78
_ARGUMENT = re.compile(r"^    (\w+): (.*(?:\n {8}.*)*)", re.MULTILINE)
"""An option and its help, in a docstring."""

RUNS, THEORY, CAMPAIGNS = "Runs", "Theory", "Campaigns"
MEASURING = "Real networks"
FILES = "Scenario files and this machine"
PROCESSES = "One terminal per process"
PANELS = (RUNS, THEORY, CAMPAIGNS, MEASURING, FILES, PROCESSES)
"""The panels of the help, in order."""

P = ParamSpec("P")
_order: dict[Any, tuple[int, int]] = {}
"""By command function: panel, and place in the panel."""


def _columns(rows: Iterable[tuple[str, str]]) -> list[str]:
    """Return commands and their descriptions as lines, at most 78 columns wide."""
    rows = list(rows)
    width = max(len(command) for command, _ in rows)
    wide = width + max(len(what) for _, what in rows) + len("     ") > _MOST_COLUMNS
    lines: list[str] = []
    for command, what in rows:
        gap = f"\n{'':6}" if wide else " " * (width - len(command) + 3)
        lines.append(f"  {command}{gap if what else ''}{what}")
    return lines


app = typer.Typer(
    name=NAME,
    cls=Program,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # importing rich takes 0.1 s
    # \b keeps the lines of a paragraph as they are.
    help="\n".join([
        "A laboratory for event-triggered control over lossy networks without acknowledgements. "
        "The loop runs as real processes over UDP; the network loses at most M − 1 consecutive "
        "packets.",
        "",
        "\b",
        *_columns(_TOUR),
        "",
        "Each command has --help, with examples at the end. A scenario is a TOML file, or the name "
        "of a shipped one. `noack --install-completion` installs shell completion.",
    ]),
)  # fmt: skip

ScenarioArgument = Annotated[
    str,
    Argument(
        help="Scenario file (TOML), or the name of a shipped scenario.",
        autocompletion=completion.scenarios,
    ),
]
RunArgument = Annotated[
    Path | None,
    Argument(
        help="Run directory; the last run by default.", autocompletion=completion.run_directories
    ),
]
LoopOption = Annotated[
    str | None, Option("--loop", metavar="NAME", help="Only the loop of this name.")
]
SetOption = Annotated[
    list[str] | None,
    Option(
        "--set",
        metavar="KEY=VALUE",
        help="Replace a value of the scenario, e.g. trigger.beta=0.3, or for short beta=0.3.",
        autocompletion=completion.settings,
    ),
]
OutOption = Annotated[Path | None, Option("--out")]


class TriggerMode(StrEnum):
    """When a simulated sensor compares its error with the threshold."""

    SAMPLED = "sampled"
    CONTINUOUS = "continuous"


TriggerOption = Annotated[
    TriggerMode,
    Option(
        help="sampled: test the trigger at each measurement, as in a live run; "
        "continuous: at all times."
    ),
]
RunsOption = Annotated[Path, Option("--runs", help="Folder of the run directories.")]
LiveOption = Annotated[
    bool,
    Option(
        "--live",
        help="Show the run in the rerun viewer: in a window, or without a display in a browser, at "
        "the address that is printed.",
    ),
]


def _log_format(context: typer.Context, wanted: LogFormat) -> LogFormat:
    """Write standard error in this format until the command ends."""
    stack = ExitStack()
    stack.enter_context(log_format(wanted))
    context.find_root().call_on_close(stack.close)
    return wanted


LogFormatOption = Annotated[
    LogFormat,
    Option(
        "--log-format",
        callback=_log_format,
        is_eager=True,
        help="Format of standard error: text, or JSON Lines for log collectors.",
    ),
]
MetricsOption = Annotated[
    str | None,
    Option(
        "--metrics",
        metavar="[HOST]:PORT",
        help="Serve the run's metrics for Prometheus (OpenMetrics) at this address; the loopback "
        "without a HOST.",
    ),
]
ReportOption = Annotated[
    bool,
    Option(
        "--report/--no-report",
        help="Write report.html, which takes some seconds; `noack report` writes it later.",
    ),
]
FormatOption = Annotated[
    FigureFormat | None,
    Option("--format", help="Write each figure as a file, too; a PDF has the fonts of LaTeX."),
]
WidthOption = Annotated[
    str | None,
    Option(
        "--width",
        metavar="column|page|INCHES",
        help="Width of figures in files: column (3.5 in), page (7.16 in), or inches; by default "
        "column for pdf, 10 in for svg and png.",
    ),
]
TablesOption = Annotated[
    Path | None,
    Option(
        "--tables",
        metavar="FOLDER",
        help="Write the tables into this folder, as LaTeX (booktabs) and as CSV.",
    ),
]
VerboseOption = Annotated[
    bool, Option("--verbose", help="Print all tables: timing, assumptions, each claim.")
]
JsonOption = Annotated[
    bool, Option("--json", help="Print one JSON document on stdout, and nothing else.")
]
SeedOption = Annotated[int, Option(help="Seed of the draws.", min=0, max=2**63 - 1)]
SESSION = Option("--session", help="Session name that the processes of a run share.")
SessionOption = Annotated[str, SESSION]


def _version(requested: bool) -> None:
    if requested:
        from importlib.metadata import version

        print(f"noack {version('noack')}")
        raise typer.Exit


@app.callback()
def options(
    _: Annotated[
        bool, Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Take the options before the command."""


def command(
    panel: str, place: int, examples: Sequence[tuple[str, str]] = (), **settings: Any
) -> Callable[[Callable[..., int]], Callable[..., None]]:
    """Register a command. Its result is the exit status; an error or Ctrl-C is printed as one line.

    The help of an option is under ``Options:`` in its docstring, unless this module declares it.

    Args:
        panel: panel of the help, one of :data:`PANELS`.
        place: sort key within the panel, ascending.
        examples: commands and their descriptions, shown at the end of the command's help.
        settings: keyword arguments of :meth:`typer.Typer.command`.
    """

    def register(function: Callable[..., int]) -> Callable[..., None]:
        @wraps(function)
        def reported(*arguments: Any, **options: Any) -> None:
            as_json = bool(options.get("json"))
            try:
                with stop_requests_raised():
                    status = function(*arguments, **options)
                if sys.stdout is not None:  # closed by the shell: >&-
                    sys.stdout.flush()
            except KeyboardInterrupt as error:
                stop = error if isinstance(error, StopRequestError) else StopRequestError()
                what = "; ".join([str(stop), *getattr(error, "__notes__", ())])
                status = failed(what, stop.exit_status, who=NAME, as_json=as_json)
            except NoackError as error:
                status = failed(str(error), error.exit_status, who=NAME, as_json=as_json)
            except Exception as error:
                if (line := exhausted_limit(error) or _why_not_written(error)) is None:
                    raise
                status = failed(line, ExitStatus.FAILED, who=NAME, as_json=as_json)
            raise typer.Exit(int(status))

        epilog = "\n".join(["\b", "Examples:", *_columns(examples)]) if examples else None
        _order[reported] = PANELS.index(panel), place
        text = _describe_options(function)
        registered: Callable[..., None] = app.command(
            rich_help_panel=panel, epilog=epilog, help=text, **settings
        )(reported)
        return registered

    return register


def _describe_options(function: Callable[..., int]) -> str:
    """Give the options of a command the help of its docstring; return the docstring before it."""
    text, _, arguments = cleandoc(function.__doc__ or "").partition("\n\nOptions:\n")
    for name, words in _ARGUMENT.findall(arguments):
        of = function.__annotations__[name]
        metadata = getattr(of, "__metadata__", ())
        described = copy(metadata[0]) if metadata else Option()
        described.help = " ".join(words.split())
        function.__annotations__[name] = Annotated[of.__origin__ if metadata else of, described]
    return text


def _why_not_written(error: Exception) -> str | None:
    """Return why standard output cannot be written; None if this is another error."""
    if not isinstance(error, OSError):
        return None
    try:
        here = Path.cwd().is_dir()
    except OSError:
        here = False
    return f"cannot write: {why(error)}" if here else "the current folder was deleted"


def register_commands(wanted: str = "") -> None:
    """Import the module that declares a command; otherwise import all, sorted for the help.

    It is found by its source, since importing all of them takes 0.05 s.
    """
    folder = Path(commands.__path__[0])
    modules = [module.name for module in pkgutil.iter_modules([str(folder)])]
    texts = {module: (folder / f"{module}.py").read_text("utf-8") for module in modules}
    declarations = f"\ndef {wanted}(", f'\n_join("{wanted}",'
    own = [module for module in modules if any(line in texts[module] for line in declarations)]
    for module in own or modules:
        import_module(f"{commands.__name__}.{module}")
    app.registered_commands.sort(key=lambda command: _order[command.callback])


def find_scenario(name: str) -> Path:
    """Return the path of a scenario given by path, or by the name of a shipped one."""
    return find_shipped(name, "scenarios")


def load_scenario(name: str, settings: Sequence[str] | None) -> "Scenario":
    """Load a scenario given by path or name, with the values of ``--set``."""
    from noack.config.scenario_file import load

    return load(find_scenario(name), settings or ())


def console() -> "Console":
    """Return a console on standard output; importing rich takes 0.05 s."""
    from rich.console import Console

    return Console()


def status(what: str) -> "AbstractContextManager[Status]":
    """Show within the context what a command is doing, on a terminal only."""
    from cosim.live.progress import error_console

    return error_console().status(what)


def write_tables(tables: "Iterable[ResultTable]", folder: Path | None, *, json: bool) -> None:
    """Write the tables of ``--tables``, if it is given; print the paths, unless with ``--json``."""
    if folder is not None:
        from cosim.output.result_tables import save_tables

        print_paths(save_tables(tables, folder), json=json)


def print_paths(paths: Iterable[Path], *, json: bool) -> None:
    """Print the paths of written files, unless the document of ``--json`` has them."""
    if not json:
        print(*paths, sep="\n")


def show(
    json: bool,
    document: Callable[[], object],
    show_text: "Callable[Concatenate[Console, P], object]",
    *found: P.args,
    **how: P.kwargs,
) -> None:
    """Print a result: the document of ``--json``, or ``show_text(console, *found, **how)``."""
    if json:
        print_json(document())
    else:
        show_text(console(), *found, **how)


def print_json(document: object) -> None:
    """Print the document of ``--json``; a number that is not finite becomes null."""
    print(dumps(_finite(document), indent=2, allow_nan=False))


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def run_program(server: "ForkServer | None" = None) -> None:
    """Run the command of the command line; a live run uses the server."""
    if sys.argv[1:2] != ["netem"]:  # the emulator ends when its output is closed
        ignore_broken_pipes()
    app(prog_name=NAME, obj=server)
