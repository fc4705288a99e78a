"""The outcome of a search for a gain: the given loop and the best one found, as results."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from cosim.output.curves import DASHED
from cosim.output.figures import palette
from cosim.output.figures.axes_parts import draw_line, rgb, whole_numbers
from cosim.output.figures.page_figure import PageFigure, one_panel
from cosim.studies.design.design_search import designed_name
from cosim.studies.design.network_search import CertifiedLoop, DesignRequest, NetworkSearch
from netem.core.clock import NS_PER_S
from netem.core.number_format import NONE, at_least, at_most
from noack.core.progress import Progress, no_progress
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import dumps, toml_text
from noack.settings.values import MatrixRows

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_GROWTH_CAPTION = (
    "Growth of the worst loss pattern found, per period: a lower bound, quickly computed. Below 1 "
    "every pattern may be stable; the marks are where this is proven."
)
HEIGHT_IN = 3.8
"""Height of the figures of a design."""


class LoopResult(NamedTuple):
    """What is found of a loop."""

    reach: str
    """The most that it is proven to tolerate."""
    cells: dict[str, str]
    """By heading."""
    document: dict[str, object]
    """As JSON."""


@dataclass(frozen=True)
class DesignOutcome:
    """The given loop and the best one found, as results."""

    name: str
    """Name of the given scenario."""
    given: LoopResult
    best: LoopResult
    notes: list[str]
    """What the reader should know, as sentences."""
    scenario: Scenario
    """That of the best loop, with the guarantee that it is proven for."""
    is_certified: bool
    """Whether the best loop is proven to tolerate anything."""
    is_better: bool
    """Whether it is another loop than the given one."""
    document: dict[str, object]
    """The limits and the size of the search, as JSON."""
    figure: PageFigure

    @property
    def verdict(self) -> str:
        """The result as a sentence."""
        if not self.is_better:
            return f"{self.best.reach} for the given loop; no better one was found"
        return f"proven stable for every loss pattern: {self.given.reach} before, {self.best.reach} after"

    @property
    def lines(self) -> str:
        """What to change in the scenario, as TOML."""
        document = self.scenario.model_dump(mode="json", exclude_none=True)
        keys = {"model": ("gain",), "network": ("mansd",), "trigger": ("policy", "period_s")}
        return toml_text(
            {table: {key: document[table][key] for key in table_keys} for table, table_keys in keys.items()}
        )

    @property
    def rows(self) -> list[tuple[str, str, str]]:
        """The comparison of both loops."""
        return [(heading, cell, self.best.cells[heading]) for heading, cell in self.given.cells.items()]

    def to_json(self) -> dict[str, object]:
        """Return the result and the lines for the scenario."""
        return {
            "scenario": self.name,
            "verdict": self.verdict,
            "lines": self.lines,
            **self.document,
            "given": self.given.document,
            "best": self.best.document,
        }

    def scenario_toml(self) -> str:
        """Return the scenario of the best loop as TOML, under a new name."""
        name = designed_name(self.name)
        description = f"{self.name}{', designed' * self.is_better}: {self.verdict}."
        return dumps(self.scenario.model_copy(update={"name": name, "description": description}))


def network_outcome(search: NetworkSearch, given: CertifiedLoop, best: CertifiedLoop) -> DesignOutcome:
    """Return what is shown of a search."""
    return DesignOutcome(
        name=search.scenario.name,
        given=_loop_result(search, given),
        best=_loop_result(search, best),
        notes=list(_notes(search)),
        scenario=search.scenario_of(best.K, best.mansd),
        is_certified=best.mansd >= 0,
        is_better=best.K != given.K,
        document={"cost_limit": search.cost_limit, "tried": search.tried, "examined": search.examined},
        figure=_growth_figure(search, given, best),
    )


def _loop_result(search: NetworkSearch, loop: CertifiedLoop) -> LoopResult:
    proven, share = loop.stability, 1 / search.measurements
    reach = "nothing proven"
    if loop.mansd >= 0:
        reach = f"at most {loop.mansd} lost in a row{', the most examined' * (loop.mansd == search.most)}"
    growth = (
        f"{at_least(proven.lower, decimals=5)} to {at_most(proven.upper, decimals=5)}" if proven else NONE
    )
    cells = {
        "proven stable for": reach,
        "growth per period there": growth,
        "the next one": _beyond_text(loop),
        "cost without losses": f"{loop.cost:.4g}",
        "share of measurements sent": f"{100 * share:.3g} %",
        "K": _gain_text(loop.K),
    }
    document: dict[str, object] = {"certified": loop.mansd if loop.mansd >= 0 else None, "cost": loop.cost}
    document |= {"transmitted": share, "K": loop.K}
    for name, stability in (("stability", proven), ("beyond", loop.beyond)):
        document[name] = stability and stability.to_json()
    return LoopResult(reach, cells, document)


def _gain_text(K: MatrixRows) -> str:
    """Return a gain as lines of text."""
    return "\n".join(" ".join(f"{entry:.6g}" for entry in row) for row in K)


def _notes(search: NetworkSearch) -> Iterator[str]:
    """Yield what the reader should know of a search."""
    limit = f"{search.cost_limit:.4g}" if math.isfinite(search.cost_limit) else "any size"
    yield (
        f"the best of {search.tried:,} loops tried, with a cost of at most {limit}; what it "
        "tolerates is proven, that it is the best is not"
    )
    wanted_s, period_s = search.request.period_s, search.period_s
    if wanted_s is not None and abs(wanted_s - period_s) > 1 / NS_PER_S:
        yield f"--period {wanted_s:g}: updates are sent at measurements, every {period_s:g} s"


def _beyond_text(loop: CertifiedLoop) -> str:
    if loop.beyond is None:
        return "not examined"
    destabilised = loop.beyond.verdict == "destabilised"
    outcome = f"{loop.beyond.text} destabilises" if destabilised else "undecided"
    return f"{loop.mansd + 1} lost in a row: {outcome}"


def _growth_figure(search: NetworkSearch, given: CertifiedLoop, best: CertifiedLoop) -> PageFigure:
    """Return the growth of both loops over the losses in a row."""
    numbers = np.arange(min(max(best.mansd, given.mansd) + 4, search.most) + 1)
    loops = ((given, "given", palette.NETWORK), (best, "designed", palette.LOST))
    growth = {
        label: np.exp(np.minimum([search.growth(loop.K, int(mansd)) for mansd in numbers], 1.1))
        for loop, label, _ in loops
    }

    def draw(axes: "Axes") -> None:
        axes.axhline(1.0, color=rgb(palette.CERTIFIED), label="stable below", dashes=DASHED, linewidth=1.6)
        for loop, label, colour in loops:
            draw_line(axes, numbers.astype(float), growth[label], colour, label=label, marker="o")
            if loop.stability is not None:
                axes.plot(
                    loop.mansd, loop.stability.upper, "*", color=rgb(colour), markersize=12,
                    label=f"{label}: proven",
                )  # fmt: skip
        axes.set(xlabel="lost in a row, at most", ylabel="growth per period")
        whole_numbers(axes, "x")

    return one_panel("growth", HEIGHT_IN, draw, caption=_GROWTH_CAPTION)


def design_for_network(
    scenario: Scenario, request: DesignRequest, progress: Progress = no_progress
) -> DesignOutcome:
    """Search for the gain with which a time-triggered loop tolerates the most losses in a row.

    The search is deterministic.

    Raises:
        CallerError: the scenario does not permit it, or a request is out of range.
    """
    search = NetworkSearch(scenario, request)
    return network_outcome(search, *search.run(progress))
