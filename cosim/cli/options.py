"""The arguments and options that commands share, and how a shell completes them."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar, dataclass_transform

import typer
from typer import Argument, Option

from cosim.lazy_modules import lazy_modules
from cosim.output.figures.figure_format import FigureFiles, FigureFormat, requested_files
from cosim.record.run_directory import DEFAULT_RUNS, LATEST, SCENARIO_FILE, chosen_run
from cosim.shipped_files import find_shipped, shipped_names
from noack.core.errors import CallerError

with lazy_modules():
    from noack.scenario import resolution, runtime_parameters, scenario, scenario_file, toml_file

if TYPE_CHECKING:
    from noack.core.linear_systems import Matrix
    from noack.scenario.scenario import Scenario

T = TypeVar("T")


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
    known = (*runtime_parameters.SHORT, *toml_file.keys(scenario.Scenario))
    return _matching(incomplete, [f"{key}=" for key in known])


def complete_runtime_parameters(incomplete: str) -> list[str]:
    """Return matching names of the runtime parameters, short and full."""
    short = runtime_parameters.SHORT
    return _matching(incomplete, [*short, *short.values()])


def _matching(incomplete: str, words: list[str]) -> list[str]:
    return [word for word in words if word.startswith(incomplete)]


def find_scenario(name: str) -> Path:
    """Return the path of a scenario given by path, or by the name of a shipped one."""
    return find_shipped(name, "scenarios")


def load_scenario(name: str, settings: Sequence[str] | None) -> "Scenario":
    """Load a scenario given by path or name, with the values of ``--set``."""
    return scenario_file.load(find_scenario(name), settings or ())


ScenarioArgument = Annotated[
    str,
    Argument(
        help="Scenario file (TOML), the name of a shipped scenario, or a run directory.",
        autocompletion=complete_scenarios,
    ),
]
RunArgument = Annotated[
    Path | None,
    Argument(help="Run directory; the last run by default.", autocompletion=complete_runs),
]
LoopOption = Annotated[str | None, Option("--loop", metavar="NAME", help="Only the loop of this name.")]
SetOption = Annotated[
    list[str] | None,
    Option(
        "--set",
        metavar="KEY=VALUE",
        help="Replace a value of the scenario, e.g. trigger.beta=0.3, or for short beta=0.3.",
        autocompletion=complete_settings,
    ),
]


def _usable_folder(folder: Path | None) -> Path | None:
    """Refuse a folder in which nothing can be written, before anything is computed."""
    if folder is not None:
        existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
        if not (existing.is_dir() and os.access(existing, os.W_OK | os.X_OK)):
            reason = "may not be written to" if existing.is_dir() else "is not a folder"
            raise typer.BadParameter(f"{existing} {reason}")
    return folder


def usable_path(path: Path | None) -> Path | None:
    """Refuse a file or folder that cannot be written, before anything is computed."""
    if path is not None:
        _usable_folder(path if path.is_dir() else path.parent)
    return path


OutOption = Annotated[Path | None, Option("--out", callback=usable_path)]
OutWithDefault = Annotated[Path, Option("--out", callback=usable_path)]


class TriggerMode(StrEnum):
    """When a simulated sensor compares its error with the threshold."""

    SAMPLED = "sampled"
    CONTINUOUS = "continuous"


TriggerOption = Annotated[
    TriggerMode,
    Option(help="sampled: test the trigger at each measurement, as in a live run; continuous: at all times."),
]
RunsOption = Annotated[Path, Option("--runs", help="Folder of the run directories.")]
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
        callback=_usable_folder,
        metavar="FOLDER",
        help="Write the tables into this folder, as CSV.",
    ),
]
VerboseOption = Annotated[
    bool, Option("--verbose", help="Print all tables: timing, assumptions, each claim.")
]
JsonOption = Annotated[bool, Option("--json", help="Print one JSON document on stdout, and nothing else.")]
SeedOption = Annotated[int, Option(help="Seed of the draws.", min=0, max=2**63 - 1)]
SESSION = Option("--session", help="Session name that the processes of a run share.")


@dataclass_transform()
def option_group(group: type[T]) -> type[T]:
    """Make a dataclass of options. With all methods that it could have, it would take 1 ms."""
    return dataclass(eq=False, repr=False)(group)


@option_group
class ScenarioOptions:
    """A scenario, and the values of ``--set``."""

    scenario: ScenarioArgument
    settings: SetOption = None

    def load(self, *more: str) -> "Scenario":
        """Load the scenario, with more settings as for ``--set``."""
        return load_scenario(self.scenario, [*(self.settings or ()), *more])


@option_group
class OneLoopOptions(ScenarioOptions):
    """The scenario of one loop; of a scenario with several, that of the loop named."""

    loop: LoopOption = None

    def load(self, *more: str) -> "Scenario":
        """Load it, with more settings of the whole scenario as for ``--set``."""
        return resolution.loop_named(super().load(*more), self.loop)


@option_group
class ExampleOptions(ScenarioOptions):
    """The same; the paper's example by default."""

    scenario: ScenarioArgument = "lane_following"


@option_group
class LoopOptions:
    """An earlier run, or one of its loops."""

    run_dir: RunArgument = None
    runs: RunsOption = DEFAULT_RUNS
    loop: LoopOption = None

    @property
    def path(self) -> Path:
        """The run's directory; raise CallerError if there is none."""
        return chosen_run(self.run_dir, self.runs)


def weight_matrix(option: str, text: str | None, size: int) -> "Matrix":
    """Return the weight that an option gives by rows, or its diagonal; None: the identity."""
    import numpy as np  # help and completion need none

    if text is None:
        return np.eye(size)
    try:
        value = np.array(scenario_file.value_of(text, option), dtype=np.float64)
    except (CallerError, ValueError, TypeError):
        value = np.empty(0)
    if value.ndim == 1:
        value = np.diag(value)
    if value.shape != (size, size) or not np.isfinite(value).all():
        example = dumps([1] * size)
        raise CallerError(
            f"{option} {text}: expected {size} x {size} numbers by rows, or {size} for the "
            f"diagonal, e.g. '{example}'"
        )
    return value


@option_group
class CostOptions:
    """The weights of a cost ∫ xᵀQx + uᵀRu dt.

    Options:
        Q: Weight of the state: rows, or a diagonal, e.g. '[1, 1]'; by default the identity.
        R: Weight of the input: rows, or a diagonal; by default the identity.
    """

    Q: Annotated[str | None, Option("--Q")] = None
    R: Annotated[str | None, Option("--R")] = None

    def matrices(self, loaded: "Scenario") -> "tuple[Matrix, Matrix]":
        """Return Q and R; raise CallerError if one is wrong."""
        n, m = loaded.model.dimensions
        return weight_matrix("--Q", self.Q, n), weight_matrix("--R", self.R, m)


@option_group
class FigureOptions:
    """How figures are written as files.

    Options:
        figure_format: Write each figure as a file, too; a PDF has the fonts of LaTeX.
    """

    figure_format: Annotated[FigureFormat | None, Option("--format")] = None
    width: WidthOption = None

    @property
    def files(self) -> FigureFiles | None:
        """The files of the figures, if any; raise CallerError if the width is wrong."""
        return requested_files(self.figure_format, self.width)
