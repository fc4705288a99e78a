"""The program ``noack``: how a command is declared, what all commands share, the entry point."""

import io
import math
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import wraps
from importlib.metadata import version
from json import dumps
from pathlib import Path
from typing import Annotated, Any

import typer

from cosim.shipped import find_shipped
from noack.errors import ExitStatus, NoackError

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    help="A laboratory for event-triggered control over lossy networks, without acknowledgements: "
    "real processes, real UDP sockets, at most M − 1 packets lost in a row.",
)

RUNS = "Runs"
THEORY = "Theory"
CAMPAIGNS = "Campaigns"
PROCESSES = "One process each, for a person with five terminals"
FILES = "Scenario files"

ScenarioArgument = Annotated[
    str, typer.Argument(help="Scenario file (TOML), or the name of a shipped scenario.")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="KEY=VALUE", help="Replace a value of the scenario, e.g. trigger.beta=0.3."
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
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print one JSON document, and nothing else, on stdout.")
]
SessionOption = Annotated[
    str, typer.Option("--session", help="Name of the session that the processes meet in.")
]

DEFAULT_RUNS = Path("runs")


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


def command(panel: str, **settings: Any) -> Callable[[Callable[..., int]], Callable[..., None]]:
    """Register a command; its result is the exit status, and a mistake becomes one line."""

    def register(function: Callable[..., int]) -> Callable[..., None]:
        @wraps(function)
        def reported(*arguments: Any, **options: Any) -> None:
            try:
                status = function(*arguments, **options)
                if sys.stdout is not None:  # a shell's >&- gives a program none
                    sys.stdout.flush()
            except NoackError as error:
                status = _failed(str(error), error.exit_status)
            except OSError as error:  # standard output is a full disk or a closed pipe
                status = _failed(f"cannot write: {error}", ExitStatus.FAILED)
            raise typer.Exit(int(status))

        registered: Callable[..., None] = app.command(rich_help_panel=panel, **settings)(reported)
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


def _failed(message: str, status: ExitStatus) -> ExitStatus:
    if "--json" in sys.argv:
        with suppress(OSError):  # it may be standard output that failed
            print_json({"error": message, "exit": {"status": int(status), "reason": message}})
    for line in message.splitlines():
        print(f"noack: {line}", file=sys.stderr)
    return status


def main() -> None:
    """Entry point."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal that cannot show ‖x‖ gets ?x?
            stream.reconfigure(errors="replace")
    try:
        app()
    except KeyboardInterrupt:
        sys.exit(ExitStatus.INTERRUPTED)
