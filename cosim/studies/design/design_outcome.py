"""The outcome of a search for a loop (:class:`DesignOutcome`), and that of time-triggered loops."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cosim.analysis.margin_search import stability_document
from cosim.output.figures import palette
from cosim.output.figures.figure_description import (
    Axis,
    FigureDescription,
    Item,
    Line,
    Marks,
    Panel,
    Rule,
    one_panel,
)
from cosim.studies.design.design_search import designed_name
from cosim.studies.design.network_search import CertifiedLoop, NetworkSearch, Requirement
from noack.core.clock import NS_PER_S
from noack.core.number_format import NONE, at_least, at_most
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import dumps, toml_text
from noack.settings.section import MatrixRows

_GROWTH_CAPTION = (
    "Growth of the worst loss pattern found, per period: a lower bound, quickly computed. Below 1 "
    "every pattern may be stable; the marks are where this is proven."
)
_MOST_REQUIREMENTS = 60
"""Largest number of requirements in the figure of the growth."""
HEIGHT_IN = 3.8
"""Height of the figures of a design."""


class LoopResult(NamedTuple):
    """What is found of a loop."""

    reach: str
    """The most that it is certified for."""
    cells: dict[str, str]
    """By heading."""
    document: dict[str, object]
    """As JSON."""


@dataclass(frozen=True)
class DesignOutcome:
    """The given loop and the best one found, as results."""

    name: str
    """Name of the given scenario."""
    claim: str
    """What is certified of both loops."""
    given: LoopResult
    best: LoopResult
    notes: Sequence[str]
    """What the reader should know of the search."""
    scenario: Scenario
    """The scenario of the best loop, with the guarantee that it is certified for."""
    is_certified: bool
    """Whether the best loop is certified for anything."""
    is_better: bool
    """Whether it is another loop than the given one."""
    document: dict[str, object]
    """The limits and the size of the search, as JSON."""
    figure: FigureDescription
    by_hold: tuple[tuple[str, str], ...] = ()
    """Hold strategies that were tried, each with the most for which no pattern destabilises its best
    loop, as far as was searched."""

    @property
    def verdict(self) -> str:
        """The result as a sentence."""
        if not self.is_better:
            return f"{self.best.reach} for the given loop; no better one was found"
        return f"{self.claim}: {self.given.reach} before, {self.best.reach} after"

    @property
    def lines(self) -> str:
        """What to change in the scenario, as TOML."""
        document = self.scenario.model_dump(mode="json", exclude_none=True)
        keys = {
            "model": ("gain",),
            "network": ("mansd", "constraints"),
            "trigger": ("policy", "period_s", "alpha_per_s", "beta"),
        }
        if "update_timeout_s" in document["controller"]:
            keys["controller"] = ("update_timeout_s", "timeout_input")
        tables = {
            table: {key: document[table][key] for key in table_keys if document[table].get(key, []) != []}
            for table, table_keys in keys.items()
        }
        return toml_text({"mode": document["mode"], **tables})

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


def gain_text(K: MatrixRows) -> str:
    """Return a gain as lines of text."""
    return "\n".join(" ".join(f"{entry:.6g}" for entry in row) for row in K)


def figure_of(name: str, panel: Panel, caption: str) -> FigureDescription:
    """Return the figure of an outcome."""
    return one_panel(name, panel, HEIGHT_IN).captioned(caption)


def periodic_outcome(search: NetworkSearch, original: CertifiedLoop, best: CertifiedLoop) -> DesignOutcome:
    """Return what is shown of a search."""
    return DesignOutcome(
        name=search.scenario.name,
        claim="proven stable for every loss pattern",
        given=_loop_result(search, original, is_excluded=not search.keeps_given_hold),
        best=_loop_result(search, best),
        notes=list(_network_notes(search, original, best)),
        scenario=search.scenario_of(best.candidate, best.level),
        is_certified=best.level >= 0,
        is_better=best.candidate != original.candidate,
        document={
            "goal": search.request.goal,
            "window": search.request.window,
            "cost_limit": search.cost_limit,
            "tried": search.tried,
            "examined": search.examined,
            "highest_by_hold": dict(search.by_hold()),
        },
        figure=_growth_figure(search, original, best),
        by_hold=tuple(search.by_hold()),
    )


def _loop_result(search: NetworkSearch, loop: CertifiedLoop, *, is_excluded: bool = False) -> LoopResult:
    requirements, (hold, K), proven = search.requirements, loop.candidate, loop.stability
    requirement = requirements[max(loop.level, 0)]
    share = search.scenario.timing.measurement_period_ns / requirement.period_ns
    reach = requirement.name + (", the most examined" if loop.level == len(requirements) - 1 else "")
    if loop.level < 0:
        reach = "nothing proven"
    growth = (
        f"{at_least(proven.lower, decimals=5)} to {at_most(proven.upper, decimals=5)}" if proven else NONE
    )
    cells = {
        "proven stable for": reach,
        "growth per period there": growth,
        "the next one": _next_requirement_text(requirements, loop),
        "cost without losses": f"{loop.cost:.4g}",
        "share of measurements sent": f"{100 * share:.3g} %",
        "between updates": hold.text + " (not in --holds)" * is_excluded,
        "K": gain_text(K),
    }
    number = None if loop.level < 0 else requirement.number
    document: dict[str, object] = {"certified": number, "cost": loop.cost, "transmitted": share}
    document |= {"mode": hold.mode, "hold": hold.text, "K": K}
    for name, stability in (("stability", proven), ("beyond", loop.beyond)):
        document[name] = stability and stability_document(stability)
    return LoopResult(reach, cells, document)


def _network_notes(search: NetworkSearch, original: CertifiedLoop, best: CertifiedLoop) -> Iterator[str]:
    """Yield what the reader should know of a search."""
    limit = f"{search.cost_limit:.4g}" if math.isfinite(search.cost_limit) else "any size"
    yield (
        f"the best of {search.tried:,} loops tried, with a cost of at most {limit}; what it "
        "tolerates is proven, that it is the best is not"
    )
    if best.level < original.level:
        hold = original.candidate.hold.text
        yield f"the given loop tolerates more than the designed one; --holds excludes its strategy, {hold}"
    period_s = search.period_ns / NS_PER_S
    if search.request.period_s is not None and round(search.request.period_s * NS_PER_S) != search.period_ns:
        yield f"--period {search.request.period_s:g}: updates are sent at measurements, every {period_s:g} s"


def _next_requirement_text(requirements: Sequence[Requirement], loop: CertifiedLoop) -> str:
    if loop.level + 1 == len(requirements):
        return "not examined"
    if loop.beyond is None:
        return f"{requirements[loop.level + 1].name}: costs too much"
    destabilised = loop.beyond.verdict == "destabilised"
    result = f"{loop.beyond.text} destabilises" if destabilised else "undecided"
    return f"{requirements[loop.level + 1].name}: {result}"


def _growth_figure(search: NetworkSearch, original: CertifiedLoop, best: CertifiedLoop) -> FigureDescription:
    """Describe the growth of both loops over the requirements."""
    requirements, request = search.requirements, search.request
    top = min(max(best.level, original.level) + 4, len(requirements))
    levels = np.unique(np.linspace(0, top - 1, min(top, _MOST_REQUIREMENTS)).astype(int))
    numbers = np.array([requirement.number for requirement in requirements])
    items: list[Item] = [Rule(at=1.0, colour=palette.CERTIFIED, label="stable below")]
    for loop, label, colour in ((original, "given", palette.NETWORK), (best, "designed", palette.LOST)):
        growth = np.exp(np.minimum([search.growth(loop.candidate, int(i)) for i in levels], 1.1))
        items.append(Line(x=numbers[levels], y=growth, colour=colour, label=label, marker="o"))
        if loop.stability is not None:
            x, y = numbers[[loop.level]], np.array([loop.stability.upper])
            mark_label = f"{label}: proven"
            items.append(Marks(x=x, y=y, colour=colour, marker="*", size=12, label=mark_label))
    x_label = "M" if request.window is None else f"losses in {request.window} updates"
    if request.goal == "transmissions":
        x_label = "time between updates [s]"
    x_axis = Axis(label=x_label, whole=request.goal == "network")
    panel = Panel(items=items, x=x_axis, y=Axis(label="growth per period"))
    return figure_of("growth", panel, _GROWTH_CAPTION)
