"""The output of a design for a network: one page (HTML) with a figure, and text for a terminal."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console

from cosim.output import palette
from cosim.output.figure_description import (
    Axis,
    FigureDescription,
    Line,
    Marks,
    Panel,
    Rule,
    one_panel,
)
from cosim.output.figure_files import save_figures
from cosim.output.figure_format import FigureFiles
from cosim.output.page_kit import templates
from cosim.output.result_tables import ResultTable, terminal_table
from cosim.studies.design.event_design import EventDesign, EventSearch
from cosim.studies.design.network_search import NetworkSearch, Progress, Reached, Wish
from noack.core.file_access import write_whole
from noack.core.number_format import NONE
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import dumps, toml_text
from noack.trigger.decaying import DecayingSettings

_DESIGNED = "_designed"
_HEIGHT_IN = 3.8
_MOST_POINTS = 60
_CAPTION = (
    "Growth of the worst loss pattern found, per period: a lower bound, quickly computed. Below 1 "
    "every pattern may be stable; the marks are where this is proven."
)
HEADINGS = ("", "given", "designed")


@dataclass(frozen=True)
class NetworkDesign:
    """The given loop and the best one found, with what they are proven to tolerate."""

    search: NetworkSearch
    given: Reached
    best: Reached

    @property
    def name(self) -> str:
        """Name of the given scenario."""
        return self.search.scenario.name

    @property
    def is_better(self) -> bool:
        """Whether it is another loop than the given one."""
        return self.best.candidate != self.given.candidate

    @property
    def notes(self) -> list[str]:
        """What the reader should know of the search."""
        limit = self.search.limit
        cost = f"{limit:.4g}" if math.isfinite(limit) else "any size: the given loop is unstable"
        return [
            f"the best of {self.search.tried:,} loops tried, with a cost of at most {cost}; what "
            "it tolerates is proven, that it is the best is not"
        ]

    @property
    def is_certified(self) -> bool:
        """Whether the best loop is proven to tolerate anything."""
        return self.best.rung >= 0

    def rung(self, reached: Reached) -> str:
        """Return what a loop is proven to reach, in words."""
        if reached.rung < 0:
            return "nothing proven"
        top = reached.rung == len(self.search.ladder) - 1
        return self.search.ladder[reached.rung].name + (", the most examined" if top else "")

    @property
    def verdict(self) -> str:
        """The verdict in one line."""
        what = {"network": "every loss pattern", "transmissions": "every loss pattern with updates"}
        before, after = self.rung(self.given), self.rung(self.best)
        if not self.is_certified:
            return "no loop was found that is proven stable"
        if self.best.rung == self.given.rung:
            return f"{after} for the given loop; no better one was found"
        return f"stable for {what[self.search.wish.goal]}: {before} before, {after} after"

    @property
    def scenario(self) -> Scenario:
        """The scenario of the best loop, with the guarantee that it is proven for."""
        return self.search.scenario_of(self.best.candidate, self.best.rung)

    @property
    def lines(self) -> str:
        """What to change in the scenario, as TOML."""
        one = self.scenario.model_dump(mode="json", exclude_none=True)
        network = {key: one["network"][key] for key in ("mansd", "constraints")}
        content = {
            "mode": one["mode"],
            "model": {"gain": one["model"]["gain"]},
            "trigger": {key: one["trigger"][key] for key in ("policy", "period_s")},
            "network": {key: value for key, value in network.items() if value != []},
        }
        return toml_text(content)

    def rows(self) -> list[tuple[str, str, str]]:
        """Return the comparison of both loops."""
        both = (self.given, self.best)
        ladder = self.search.ladder

        def row(heading: str, *cells: str) -> tuple[str, str, str]:
            return heading, cells[0], cells[1]

        def bounds(one: Reached) -> str:
            return f"{one.found.lower:.5f} to {one.found.upper:.5f}" if one.found else NONE

        def beyond(one: Reached) -> str:
            if one.beyond is None:
                return "not examined"
            at = ladder[one.rung + 1].name
            if one.beyond.verdict == "destabilised":
                return f"{at}: {one.beyond.text} destabilises"
            return f"{at}: undecided"

        return [
            row("proven stable for", *(self.rung(one) for one in both)),
            row("growth per period there", *(bounds(one) for one in both)),
            row("the next one", *(beyond(one) for one in both)),
            row("cost without losses", *(f"{one.cost:.4g}" for one in both)),
            row("share of measurements sent", *(f"{100 * self.share(one):.3g} %" for one in both)),
            row("between updates", *(_HOLDS[one.candidate.mode] for one in both)),
            row("K", *(_matrix(one) for one in both)),
        ]

    def share(self, reached: Reached) -> float:
        """Return the share of the measurements that are transmitted."""
        period_ns = self.search.ladder[max(reached.rung, 0)].period_ns
        return self.search.scenario.timing.measurement_period_ns / period_ns

    def document(self) -> dict[str, object]:
        """Return the result as JSON."""

        def loop(one: Reached) -> dict[str, object]:
            stable = one.found and one.found._asdict() | {"pattern": one.found.text}
            beyond = one.beyond and one.beyond._asdict() | {"pattern": one.beyond.text}
            return {
                "certified": None if one.rung < 0 else self.search.ladder[one.rung].number,
                "mode": one.candidate.mode, "K": one.candidate.K, "cost": one.cost,
                "transmitted": self.share(one), "stability": stable,
                "beyond": beyond and beyond | {"verdict": one.beyond and one.beyond.verdict},
            }  # fmt: skip

        search = self.search
        return {
            "scenario": self.name, "goal": search.wish.goal, "window": search.wish.window,
            "cost_limit": search.limit, "tried": search.tried, "judged": search.judged,
            "given": loop(self.given), "best": loop(self.best), "verdict": self.verdict,
            "lines": self.lines,
        }  # fmt: skip

    def figure(self) -> FigureDescription:
        """Describe the growth of both loops over the ladder."""
        search, ladder = self.search, self.search.ladder
        top = min(max(self.best.rung, self.given.rung) + 4, len(ladder))
        rungs = np.unique(np.linspace(0, top - 1, min(top, _MOST_POINTS)).astype(int))
        numbers = np.array([one.number for one in ladder])
        items: list[Line | Rule | Marks] = [
            Rule(at=1.0, colour=palette.CERTIFIED, label="stable below")
        ]
        for reached, label, colour in (
            (self.given, "given", palette.NETWORK), (self.best, "designed", palette.LOST),
        ):  # fmt: skip
            logs = [search.growth(reached.candidate, int(rung)) for rung in rungs]
            growth = np.array([math.exp(min(one, 300.0)) for one in logs])
            shown = growth < 3.0
            items.append(Line(x=numbers[rungs][shown], y=growth[shown], colour=colour, label=label,
                              marker="o", size=3.0))  # fmt: skip
            if reached.found is not None:
                items.append(Marks(
                    x=numbers[[reached.rung]], y=np.array([reached.found.upper]), colour=colour,
                    marker="*", size=12, label=f"{label}: proven",
                ))  # fmt: skip
        along = {"network": "M", "transmissions": "time between updates [s]"}[search.wish.goal]
        if search.wish.window is not None:
            along = f"losses in {search.wish.window} updates"
        panel = Panel(items=items, x=Axis(label=along, whole=search.wish.goal == "network"),
                      y=Axis(label="growth per period"))  # fmt: skip
        return one_panel("growth", panel, _HEIGHT_IN).captioned(_CAPTION)


_HOLDS = {"model": "the model's input", "zoh": "hold"}


def _matrix(reached: Reached) -> str:
    return "\n".join(" ".join(f"{entry:.6g}" for entry in row) for row in reached.candidate.K)


AnyDesign = NetworkDesign | EventDesign


def design_for_network(
    scenario: Scenario, wish: Wish, seed: int = 0, progress: Progress = lambda share: None
) -> AnyDesign:
    """Search for a loop; with a period it is time-triggered. The result is deterministic.

    Raises:
        CallerError: the scenario does not permit it, or a wish is out of range.
    """
    if wish.period_s is None and isinstance(scenario.trigger, DecayingSettings):
        events = EventSearch(scenario, wish, seed)
        return EventDesign(events, *events.run(progress))
    search = NetworkSearch(scenario, wish)
    return NetworkDesign(search, *search.run(progress))


def written_scenario(design: AnyDesign) -> Scenario:
    """Return the scenario of the best loop under a new name."""
    name = f"{design.name.removesuffix(_DESIGNED)[: 64 - len(_DESIGNED)]}{_DESIGNED}"
    about = f"{design.name} with another gain: {design.verdict}."
    return design.scenario.model_copy(update={"name": name, "description": about})


def write_page(
    design: AnyDesign, path: Path, figure_files: FigureFiles | None = None
) -> list[Path]:
    """Write page and figure; return the files.

    Raises:
        MachineError: they cannot be written.
    """
    figure = design.figure()
    html = templates(Path(__file__).parent).get_template("network.html.jinja").render(
        title=design.name,
        subtitle=f"{design.search.tried:,} loops tried, {design.search.judged} judged",
        verdict=design.verdict,
        tone="good" if design.is_better else "doubt",
        figure=figure,
        headings=HEADINGS,
        rows=design.rows(),
        scenario_toml=dumps(written_scenario(design)),
    )  # fmt: skip
    return [write_whole(path, html), *save_figures([figure], path, figure_files)]


def print_design(console: Console, design: AnyDesign) -> None:
    """Print the comparison, the verdict, and the lines for the scenario."""
    table = ResultTable("design", f"{design.name}: loops under the worst losses", HEADINGS,
                        design.rows())  # fmt: skip
    console.print(terminal_table(table, left=range(3)))
    lines = [design.verdict, *design.notes]
    if design.is_certified:
        lines.append(f"for the scenario:\n{design.lines.rstrip()}")
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)
