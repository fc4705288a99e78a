"""What is shown of a search for time-triggered loops: the results of two loops, notes, a figure."""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from cosim.analysis.margin_search import stability_document
from cosim.output.figures import palette
from cosim.output.figures.figure_description import Axis, FigureDescription, Item, Line, Marks, Panel, Rule
from cosim.studies.design.design_page import DesignOutcome, LoopResult, figure_of, gain_text
from cosim.studies.design.network_search import CertifiedLoop, NetworkSearch, Requirement
from noack.core.clock import NS_PER_S
from noack.core.number_format import NONE, at_least, at_most

_MOST_POINTS = 60
"""Largest number of requirements in the figure."""
_CAPTION = (
    "Growth of the worst loss pattern found, per period: a lower bound, quickly computed. Below 1 "
    "every pattern may be stable; the marks are where this is proven."
)


def periodic_outcome(search: NetworkSearch, original: CertifiedLoop, best: CertifiedLoop) -> DesignOutcome:
    """Return what is shown of a search."""
    return DesignOutcome(
        search.scenario.name,
        "proven stable for every loss pattern",
        _loop_result(search, original, is_excluded=not search.keeps_given_hold),
        _loop_result(search, best),
        list(_notes(search, original, best)),
        search.scenario_of(best.candidate, best.level),
        best.level >= 0,
        best.candidate != original.candidate,
        {
            "goal": search.request.goal,
            "window": search.request.window,
            "cost_limit": search.limit,
            "tried": search.tried,
            "judged": search.judged,
            "highest_by_hold": dict(search.by_hold()),
        },
        _figure(search, original, best),
        tuple(search.by_hold()),
    )


def _loop_result(search: NetworkSearch, loop: CertifiedLoop, *, is_excluded: bool = False) -> LoopResult:
    requirements, (hold, K), proven = search.requirements, loop.candidate, loop.stability
    requirement = requirements[max(loop.level, 0)]
    sent = search.scenario.timing.measurement_period_ns / requirement.period_ns
    reach = requirement.name + (", the most examined" * (loop.level == len(requirements) - 1))
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
        "share of measurements sent": f"{100 * sent:.3g} %",
        "between updates": hold.text + " (not in --holds)" * is_excluded,
        "K": gain_text(K),
    }
    certified = None if loop.level < 0 else requirement.number
    document: dict[str, object] = {"certified": certified, "cost": loop.cost, "transmitted": sent}
    document |= {"mode": hold.mode, "hold": hold.text, "K": K}
    for name, stability in (("stability", proven), ("beyond", loop.beyond)):
        document[name] = stability and stability_document(stability)
    return LoopResult(reach, cells, document)


def _notes(search: NetworkSearch, original: CertifiedLoop, best: CertifiedLoop) -> Iterator[str]:
    """Yield what the reader should know of a search."""
    limit = f"{search.limit:.4g}" if math.isfinite(search.limit) else "any size"
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


def _figure(search: NetworkSearch, original: CertifiedLoop, best: CertifiedLoop) -> FigureDescription:
    """Describe the growth of both loops over the requirements."""
    requirements, request = search.requirements, search.request
    top = min(max(best.level, original.level) + 4, len(requirements))
    levels = np.unique(np.linspace(0, top - 1, min(top, _MOST_POINTS)).astype(int))
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
    return figure_of("growth", panel, _CAPTION)
