"""Declaration of ``noack``'s commands, their shared functions, and the entry point."""

import math
import pkgutil
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from enum import StrEnum
from functools import wraps
from importlib import import_module
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cosim.cli import commands, completion
from cosim.cli.program import NAME, Program, be_patient
from cosim.output.figure_format import FigureFormat
from cosim.record.run_directory import DEFAULT_RUNS as DEFAULT_RUNS
from cosim.shipped_files import find_shipped
from noack.core.errors import ExitStatus, NoackError, why
from noack.core.process_limits import exhausted_limit
from noack.core.python_process import cores as cores
from noack.runtime.command_line import failed
from noack.runtime.json_log import LogFormat as LogFormat
from noack.runtime.json_log import log_format
from noack.runtime.signals import StopRequestError, stop_requests_raised

if TYPE_CHECKING:
    from rich.console import Console

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

RUNS, THEORY, CAMPAIGNS = "Runs", "Theory", "Campaigns"
MEASURING = "Real networks"
FILES = "Scenario files and this machine"
PROCESSES = "One terminal per process"
PANELS = (RUNS, THEORY, CAMPAIGNS, MEASURING, FILES, PROCESSES)
"""The panels of the help, in order."""

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
    typer.Argument(
        help="Scenario file (TOML), or the name of a shipped scenario.",
        autocompletion=completion.scenarios,
    ),
]
RunArgument = Annotated[
    Path | None,
    typer.Argument(
        help="Run directory; the last run by default.", autocompletion=completion.run_directories
    ),
]
LoopOption = Annotated[
    str | None,
    typer.Option("--loop", metavar="NAME", help="Only the loop of this name."),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Replace a value of the scenario, e.g. trigger.beta=0.3, or for short beta=0.3.",
        autocompletion=completion.settings,
    ),
]


class TriggerMode(StrEnum):
    """When a simulated sensor compares its error with the threshold."""

    SAMPLED = "sampled"
    CONTINUOUS = "continuous"


TriggerOption = Annotated[
    TriggerMode,
    typer.Option(
        help="sampled: test the trigger at each measurement, as in a live run; "
        "continuous: at all times."
    ),
]
RunsOption = Annotated[Path, typer.Option("--runs", help="Folder of the run directories.")]
LiveOption = Annotated[
    bool,
    typer.Option(
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
    typer.Option(
        "--log-format",
        callback=_log_format,
        is_eager=True,
        help="Format of standard error: text, or JSON Lines for log collectors.",
    ),
]
MetricsOption = Annotated[
    str | None,
    typer.Option(
        "--metrics",
        metavar="[HOST]:PORT",
        help="Serve the run's metrics for Prometheus (OpenMetrics) at this address; the loopback "
        "without a HOST.",
    ),
]
ReportOption = Annotated[
    bool,
    typer.Option(
        "--report/--no-report",
        help="Write report.html, which takes some seconds; `noack report` writes it later.",
    ),
]
FormatOption = Annotated[
    FigureFormat | None,
    typer.Option(
        "--format",
        help="Write each figure as a file, too; pdf and pgf have the fonts of LaTeX.",
    ),
]
WidthOption = Annotated[
    str | None,
    typer.Option(
        "--width",
        metavar="column|page|INCHES",
        help="Width of figures in files: column (3.5 in), page (7.16 in), or inches; by default "
        "column for pdf and pgf, 10 in for svg and png.",
    ),
]
TablesOption = Annotated[
    Path | None,
    typer.Option(
        "--tables",
        metavar="FOLDER",
        help="Write the tables into this folder, as LaTeX (booktabs) and as CSV.",
    ),
]
VerboseOption = Annotated[
    bool, typer.Option("--verbose", help="Print all tables: timing, assumptions, each claim.")
]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print one JSON document on stdout, and nothing else.")
]
SESSION = typer.Option("--session", help="Session name that the processes of a run share.")
SessionOption = Annotated[str, SESSION]


def _version(requested: bool) -> None:
    if requested:
        from importlib.metadata import version

        print(f"noack {version('noack')}")
        raise typer.Exit


@app.callback()
def options(
    _: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Take the options before the command."""


def command(
    panel: str, place: int, examples: Sequence[tuple[str, str]] = (), **settings: Any
) -> Callable[[Callable[..., int]], Callable[..., None]]:
    """Register a command. Its result is the exit status; an error or Ctrl-C is printed as one line.

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
        registered: Callable[..., None] = app.command(
            rich_help_panel=panel, epilog=epilog, **settings
        )(reported)
        return registered

    return register


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
    modules = [one.name for one in pkgutil.iter_modules(commands.__path__)]
    folder, declaration = Path(commands.__path__[0]), f"\ndef {wanted}("
    own = [one for one in modules if declaration in (folder / f"{one}.py").read_text("utf-8")]
    for module in own or modules:
        import_module(f"{commands.__name__}.{module}")
    app.registered_commands.sort(key=lambda one: _order[one.callback])


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


def write_tables(tables: "Iterable[ResultTable]", folder: Path | None, *, json: bool) -> None:
    """Write the tables of ``--tables``, if it is given; print the paths, unless with ``--json``."""
    if folder is not None:
        from cosim.output.result_tables import save_tables

        written = save_tables(tables, folder)
        if not json:
            print(*written, sep="\n")


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
        be_patient()
    app(prog_name=NAME, obj=server)
