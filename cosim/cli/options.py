"""What commands share: the panels of the help, arguments and options, and how a shell completes them.

A command imports what is large within its function. So help and completion need none of it.
"""

from collections.abc import Sequence
from contextlib import ExitStack
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from cosim.output.figures.figure_format import FigureFormat
from cosim.output.requirement import Requirement
from cosim.record.run_directory import DEFAULT_RUNS, LATEST, SCENARIO_FILE, require_folder, require_output
from cosim.shipped_files import find_shipped, shipped_names
from netem.core.command_line import LogFormat, log_format

if TYPE_CHECKING:
    from noack.scenario.scenario import Scenario

RUNS, THEORY, CAMPAIGNS = "Runs", "Theory", "Campaigns"
MEASURING = "Real networks"
FILES = "Scenario files and this machine"
PROCESSES = "One terminal per process"
PANELS = (RUNS, THEORY, CAMPAIGNS, MEASURING, FILES, PROCESSES)
"""The panels of the help, in order."""


def examples(*rows: tuple[str, str]) -> str:
    """Return the end of a command's help (Markdown): commands, each with its description."""
    return "\n".join(["Examples:", "", *(f"- `{command}` – {meaning}" for command, meaning in rows)])


def complete_scenarios(incomplete: str) -> list[str]:
    """Return matching names of shipped scenarios; the shell completes file names itself."""
    return _matching(incomplete, shipped_names("scenarios"))


def complete_campaigns(incomplete: str) -> list[str]:
    """Return matching names of shipped campaigns."""
    return _matching(incomplete, shipped_names("campaigns"))


def complete_shipped(incomplete: str) -> list[str]:
    """Return matching names of shipped scenarios and campaigns."""
    return complete_scenarios(incomplete) + complete_campaigns(incomplete)


def complete_runs(incomplete: str) -> list[str]:
    """Return matching run directories below ``runs``, the newest first."""
    directories = [path.parent for path in DEFAULT_RUNS.glob(f"*/{SCENARIO_FILE}")]
    by_name = sorted(directories, key=lambda path: (path.name == LATEST, path.name), reverse=True)
    return _matching(incomplete, [str(path) for path in by_name])


def complete_settings(incomplete: str) -> list[str]:
    """Return matching keys for ``--set``, each with its =."""
    from netem.core.toml_file import keys
    from noack.scenario.runtime_parameters import SHORT
    from noack.scenario.scenario import Scenario

    return _matching(incomplete, [f"{key}=" for key in (*SHORT, *keys(Scenario))])


def complete_runtime_parameters(incomplete: str) -> list[str]:
    """Return matching names of the runtime parameters, short and full."""
    from noack.scenario.runtime_parameters import SHORT

    return _matching(incomplete, [*SHORT, *SHORT.values()])


def _matching(incomplete: str, words: list[str]) -> list[str]:
    return [word for word in words if word.startswith(incomplete)]


def usable_folder(folder: Path | None) -> Path | None:
    """Refuse a folder in which nothing can be written, before anything is computed."""
    if folder is not None:
        require_folder(folder)
    return folder


def usable_path(path: Path | None) -> Path | None:
    """Refuse a file that cannot be written, before anything is computed."""
    if path is not None:
        require_output(path)
    return path


def find_scenario(name: str) -> Path:
    """Return the path of a scenario given by path, or by the name of a shipped one."""
    return find_shipped(name, "scenarios")


def load_scenario(name: str, settings: Sequence[str] | None, network: Path | None = None) -> "Scenario":
    """Load a scenario given by path or name, with the network of a file and the values of ``--set``."""
    from noack.scenario.scenario_file import load, require_keys_once

    require_keys_once(settings or ())
    return load(find_scenario(name), settings or (), network=network)


def load_loop(
    name: str, settings: Sequence[str] | None, loop: str | None, network: Path | None = None
) -> "Scenario":
    """Load the scenario of one loop; of a scenario with several, that of the loop named."""
    from noack.scenario.resolution import loop_named

    return loop_named(load_scenario(name, settings, network), loop)


def require_linux() -> None:
    """Raise CallerError where there are no live runs; what a live run imports may be missing there."""
    from netem.core.core_library import require_live_runs

    require_live_runs()


class TriggerMode(StrEnum):
    """When a simulated sensor compares its error with the threshold."""

    SAMPLED = "sampled"
    CONTINUOUS = "continuous"


ScenarioArgument = Annotated[
    str,
    Argument(
        help="Scenario file (TOML), the name of a shipped scenario, or a run directory.",
        autocompletion=complete_scenarios,
    ),
]
SetOption = Annotated[
    list[str] | None,
    Option(
        "--set",
        metavar="KEY=VALUE",
        help="Replace a value of the scenario, e.g. trigger.beta=0.3, or for short beta=0.3; "
        "KEY=none takes a key out.",
        autocompletion=complete_settings,
    ),
]
NetworkOption = Annotated[
    Path | None,
    Option(
        "--network",
        metavar="FILE",
        help="Take the table [network] of this file, e.g. one of `noack measure TRACE --write FILE`.",
    ),
]
RunArgument = Annotated[
    Path | None,
    Argument(help="Run directory; the last run by default.", autocompletion=complete_runs),
]
RunsOption = Annotated[Path, Option("--runs", help="Folder of the run directories.")]
LoopOption = Annotated[str | None, Option("--loop", metavar="NAME", help="Only the loop of this name.")]
SESSION = Option("--session", help="Session name that the processes of a run share.")
TriggerOption = Annotated[
    TriggerMode,
    Option(help="sampled: test the trigger at each measurement, as in a live run; continuous: at all times."),
]
ReportOption = Annotated[
    bool,
    Option(
        "--report/--no-report",
        help="Write report.html, which takes about 2 s; `noack report` writes it later.",
    ),
]
LiveOption = Annotated[
    bool,
    Option(
        "--live",
        help="Show the run in the rerun viewer: in a window, or without a display in a browser, at "
        "the address that is printed.",
    ),
]


def _log_format(context: typer.Context, chosen: LogFormat) -> LogFormat:
    """Write standard error in this format until the command ends."""
    stack = ExitStack()
    stack.enter_context(log_format(chosen))
    context.find_root().call_on_close(stack.close)
    return chosen


LogFormatOption = Annotated[
    LogFormat,
    Option(
        callback=_log_format,
        is_eager=True,
        help="Format of standard error: text, or JSON Lines for log collectors.",
    ),
]
FigureFormatOption = Annotated[
    FigureFormat | None,
    Option("--format", help="Write each figure as a file, too; a PDF has the fonts of printed papers."),
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
        callback=usable_folder,
        metavar="FOLDER",
        help="Write the tables into this folder, as CSV.",
    ),
]
StateWeightOption = Annotated[
    str | None,
    Option("--Q", help="Weight of the state: rows, or a diagonal, e.g. '[1, 1]'; by default the identity."),
]
InputWeightOption = Annotated[
    str | None,
    Option("--R", help="Weight of the input: rows, or a diagonal; by default the identity."),
]
SeedOption = Annotated[int, Option(help="Seed of the draws.", min=0, max=2**63 - 1)]
RequireOption = Annotated[
    list[Requirement] | None,
    Option(
        "--require",
        help="Exit with status 1, and one line that says why, unless: certificate: one covers the "
        "plant and the whole run; guarantee: it was kept, as the verdict says; stable: ‖x‖ fell to a "
        "tenth of its largest value. Can be repeated.",
    ),
]
VerboseOption = Annotated[
    bool, Option("--verbose", help="Print all tables: timing, assumptions, each claim.")
]
JsonOption = Annotated[bool, Option("--json", help="Print one JSON document on stdout, and nothing else.")]
