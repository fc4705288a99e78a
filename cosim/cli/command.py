"""How a command of ``noack`` is declared, what all commands share, the entry point."""

import math
import os
import sys
from collections.abc import Callable, Sequence
from functools import wraps
from importlib.metadata import version
from json import dumps
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape

from cosim.cli import completion
from cosim.cli.program import NAME, Program, be_patient
from cosim.shipped_files import find_shipped
from noack.core.errors import ExitStatus, NoackError, why
from noack.runtime.command_line import failed

_STORY = (
    ("noack doctor", "what this machine grants to a run"),
    ("noack run lane_following", "the loop live, as five processes, recorded"),
    ("noack view", "the last run, drawn"),
    ("noack simulate lane_following", "the same in virtual time, in a second"),
    ("noack certify lane_following", "what is guaranteed, on which conditions"),
    ("noack fidelity", "how far the last run is from the ideal loop"),
    ("noack compare A B", "two or more runs, side by side"),
    ("noack campaign mb_vs_zoh", "many runs over a grid of settings"),
    ("noack netem --explain loss 5%", "the network emulator, for any UDP program"),
)
"""The commands in the order in which somebody meets them."""
_MOST_COLUMNS = 78


def _columns(rows: Sequence[tuple[str, str]]) -> list[str]:
    """Commands and what they are for, as lines of rich's markup that no terminal need wrap."""
    width = max(len(command) for command, _ in rows)
    wide = width + max(len(what) for _, what in rows) + len("     ") > _MOST_COLUMNS
    lines: list[str] = []
    for command, what in rows:
        gap = f"\n{'':6}" if wide else " " * (width - len(command) + 3)
        lines.append(f"  [cyan]{escape(command)}[/]{gap if what else ''}{escape(what)}")
    return lines


app = typer.Typer(
    name=NAME,
    cls=Program,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    # The first character has the lines left as they are; an empty one would end the paragraph.
    help="\n".join([
        "\b",
        "A laboratory for event-triggered control over lossy networks, without acknowledgements: "
        "real processes, real UDP sockets, at most M − 1 packets lost in a row.",
        " ",
        *_columns(_STORY),
        " ",
        "Each command has --help, which ends with examples. Scenarios are files (TOML), or names "
        "of those that come with noack. `noack --install-completion` lets your shell complete "
        "commands, names and keys.",
    ]),
)  # fmt: skip

RUNS = "Runs"
THEORY = "Theory"
CAMPAIGNS = "Campaigns"
PROCESSES = "One process each, for a person with five terminals"
FILES = "Scenario files, and this machine"

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
        help="A run directory; by default the last run.", autocompletion=completion.run_directories
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Replace a value of the scenario, e.g. trigger.beta=0.3.",
        autocompletion=completion.settings,
    ),
]
RunsOption = Annotated[Path, typer.Option("--runs", help="Where run directories are made.")]
LiveOption = Annotated[bool, typer.Option("--live", help="Show the run in the rerun viewer.")]
ReportOption = Annotated[
    bool,
    typer.Option(
        "--report/--no-report",
        help="Draw report.html, which takes some seconds; `noack report` does it later.",
    ),
]
VerboseOption = Annotated[
    bool, typer.Option("--verbose", help="Show all tables: timing, assumptions, each claim.")
]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print one JSON document, and nothing else, on stdout.")
]
SESSION = typer.Option("--session", help="Name of the session that the processes meet in.")
SessionOption = Annotated[str, SESSION]


def _version(asked: bool) -> None:
    if asked:
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
    panel: str, examples: Sequence[tuple[str, str]] = (), **settings: Any
) -> Callable[[Callable[..., int]], Callable[..., None]]:
    """Register a command; its result is the exit status, and a mistake becomes one line.

    Args:
        panel: of the help.
        examples: commands, and what they are for; the command's own help ends with them.
        settings: of :meth:`typer.Typer.command`.
    """

    def register(function: Callable[..., int]) -> Callable[..., None]:
        @wraps(function)
        def reported(*arguments: Any, **options: Any) -> None:
            as_json = bool(options.get("json"))
            try:
                status = function(*arguments, **options)
                if sys.stdout is not None:  # a shell's >&- gives a program none
                    sys.stdout.flush()
            except NoackError as error:
                status = failed(str(error), error.exit_status, who=NAME, as_json=as_json)
            except OSError as error:  # standard output is a full disk
                what = f"cannot write: {why(error)}"
                status = failed(what, ExitStatus.FAILED, who=NAME, as_json=as_json)
            raise typer.Exit(int(status))

        # The first line is there to be left alone: a later one says how far all are indented.
        epilog = "\n".join(["", "[bold]Examples[/]", *_columns(examples)]) if examples else None
        registered: Callable[..., None] = app.command(
            rich_help_panel=panel, epilog=epilog, **settings
        )(reported)
        return registered

    return register


def find_scenario(name: str) -> Path:
    """Return the path of a scenario given by path, or by the name of a shipped one."""
    return find_shipped(name, "scenarios")


def cores() -> int:
    """How many processors this process may use."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def print_json(document: object) -> None:
    """Print the one document of ``--json``; a number that is not finite becomes null."""
    print(dumps(_finite(document), indent=2, allow_nan=False))


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def main() -> None:
    """Entry point."""
    if sys.argv[1:2] != ["netem"]:  # which ends when nobody reads any more
        be_patient()
    try:
        app(prog_name=NAME)
    except KeyboardInterrupt:
        sys.exit(ExitStatus.INTERRUPTED)
