"""The outcome of a design for a network: one page (HTML) with a figure, and text for a terminal."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from cosim.output.figure_description import FigureDescription, Panel, one_panel
from cosim.output.figure_files import save_figures
from cosim.output.figure_format import FigureFiles
from cosim.output.page_kit import templates
from cosim.output.result_tables import ResultTable, terminal_table
from noack.core.file_access import write_whole
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import dumps, toml_text
from noack.settings.section import Rows

_DESIGNED = "_designed"
_HEIGHT_IN = 3.8
_HEADINGS = ("", "given", "designed")


@dataclass(frozen=True)
class DesignOutcome:
    """The given loop and the best one found, as results."""

    name: str
    """Name of the given scenario."""
    verdict: str
    notes: Sequence[str]
    """What the reader should know of the search."""
    cells: tuple[dict[str, str], dict[str, str]]
    """Of the given loop and the best one, by heading."""
    scenario: Scenario
    """The scenario of the best loop, with the guarantee that it is certified for."""
    is_certified: bool
    """Whether the best loop is certified for anything."""
    is_better: bool
    """Whether it is another loop than the given one."""
    document: dict[str, object]
    """The limits and the size of the search, as JSON."""
    given: dict[str, object]
    """The given loop as JSON."""
    best: dict[str, object]
    figure: FigureDescription

    @property
    def lines(self) -> str:
        """What to change in the scenario, as TOML."""
        one = self.scenario.model_dump(mode="json", exclude_none=True)
        keys = {
            "model": ("gain",),
            "network": ("mansd", "constraints"),
            "trigger": ("policy", "period_s", "alpha_per_s", "beta"),
        }
        tables = {
            table: {key: one[table][key] for key in some if one[table].get(key, []) != []}
            for table, some in keys.items()
        }
        return toml_text({"mode": one["mode"], **tables})

    @property
    def rows(self) -> list[tuple[str, str, str]]:
        """The comparison of both loops."""
        given, best = self.cells
        return [(heading, given[heading], best[heading]) for heading in given]

    def to_json(self) -> dict[str, object]:
        """Return the result and the lines for the scenario."""
        return {
            "scenario": self.name,
            "verdict": self.verdict,
            "lines": self.lines,
            **self.document,
            "given": self.given,
            "best": self.best,
        }

    def written(self) -> str:
        """Return the scenario of the best loop as TOML, under a new name."""
        name = f"{self.name.removesuffix(_DESIGNED)[: 64 - len(_DESIGNED)]}{_DESIGNED}"
        about = f"{self.name} with another gain: {self.verdict}."
        return dumps(self.scenario.model_copy(update={"name": name, "description": about}))


def gain_text(K: Rows) -> str:
    """Return a gain as lines of text."""
    return "\n".join(" ".join(f"{entry:.6g}" for entry in row) for row in K)


def figure_of(name: str, panel: Panel, caption: str) -> FigureDescription:
    """Return the figure of an outcome."""
    return one_panel(name, panel, _HEIGHT_IN).captioned(caption)


def write_page(found: DesignOutcome, path: Path, figure_files: FigureFiles | None = None) -> list[Path]:
    """Write page and figure; return the files.

    Raises:
        MachineError: they cannot be written.
    """
    page = templates(Path(__file__).parent).get_template("network.html.jinja")
    html = page.render(found=found, headings=_HEADINGS, scenario_toml=found.written())
    return [write_whole(path, html), *save_figures([found.figure], path, figure_files)]


def print_design(console: Console, found: DesignOutcome) -> None:
    """Print the comparison, the verdict, and the lines for the scenario."""
    title = f"{found.name}: loops under the worst losses"
    table = ResultTable("design", title, _HEADINGS, found.rows)
    console.print(terminal_table(table, left=range(3)))
    lines = [found.verdict, *found.notes]
    if found.is_certified:
        lines.append(f"for the scenario:\n{found.lines.rstrip()}")
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)
