"""The figures of the page: the paper's Fig. 2 and 3 for one draw, and all draws together."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from cosim.output import palette
from cosim.output.report.axes import Shown, finish, layout, logarithmic
from cosim.output.report.figure_style import INK, printed, styled
from cosim.output.report.signal_figures import paper_figure
from cosim.simulation.continuous import ContinuousRun, timeless
from cosim.studies.paper.paper_campaign import MODES, Mode
from cosim.studies.paper.paper_results import Results
from netem.channel import UPDATE_LINK
from netem.link_state import LinkState
from noack.config.scenario import Scenario
from noack.core.linear_systems import Vector
from noack.protocol.record_tables import Fate, effective

SHOWN_S = 20.0
"""The representative draw is shown up to this time; later values are too small to be visible."""
_STEP_S = 0.01
_BINS = 30
_PANELS = (
    ("events", "transmissions", "count", True),
    ("deliveries", "deliveries", "count", True),
    ("settled_5_s", "settling to 5 %", "time [s]", False),
    ("gap_min_s", "shortest interval", "time [s]", True),
)
_HEIGHT_IN = 5.3
_COLOURS: Mapping[Mode, Any] = {
    "model": printed(palette.SERIES[2]),
    "zoh": printed(palette.SERIES[3]),
}
_DOT = printed(palette.PLANT)


def draw_figure(run: ContinuousRun, resolved: Scenario, draw: int) -> Figure:
    """Draw states, broadcasting and receiving intervals of one loop of a draw."""
    shown = run.event_s <= SHOWN_S
    samples = run.at(np.linspace(0.0, SHOWN_S, round(SHOWN_S / _STEP_S) + 1))
    fates = _fates(resolved, int(shown.sum()))
    event_s = run.event_s[shown]
    return paper_figure(
        mode=resolved.mode,
        t_s=samples.t_s,
        x=samples.x,
        x_s=samples.x_s,
        x_c=samples.x_c,
        state_names=run.system.loop.state_names,
        broadcast_s=event_s,
        dropped=~effective(fates),
        received_s=event_s[effective(fates)],
        forced=fates[effective(fates)] == Fate.FORCED,
        title=f"draw {draw}",
    )


def _fates(resolved: Scenario, events: int) -> NDArray[np.int64]:
    """Return the network's decision for each of the first updates, (events,)."""
    link = LinkState(timeless(resolved.network.link), resolved.seeds.loss, UPDATE_LINK)
    link.start_flow(0, 0)
    return np.array([link.decide(0, 1, 0).fate for _ in range(events)], dtype=np.int64)


@styled
def ensemble_figure(results: Results) -> Figure:
    """Draw the distributions over the draws, and below them both loops of each draw as points."""
    figure = Figure(figsize=(layout().width_in, _HEIGHT_IN), layout="constrained")
    panels = figure.subplots(2, len(_PANELS), height_ratios=(4, 5))
    shown: list[Shown] = []
    for (above, below), (name, title, unit, logarithm) in zip(panels.T, _PANELS, strict=True):
        both: dict[Mode, Vector] = {mode: results.column(f"{mode}.{name}") for mode in MODES}
        shown = _histogram(above, both, logarithm=logarithm)
        above.set(title=title, xlabel=unit)
        _against(below, both["model"], both["zoh"], logarithm=logarithm)
        below.set(xlabel=f"MB-ET, {unit}", ylabel=f"ZOH-ET, {unit}")
    panels[0, 0].set(ylabel="draws")
    handles, labels = zip(*shown, strict=True)
    figure.legend(handles, labels, loc="outside upper right", ncols=len(labels))
    figure.suptitle(
        f"{results.count():,} draws, each with MB-ET and ZOH-ET",
        x=0.005, ha="left", weight="bold", size=layout().title_pt,
    )  # fmt: skip
    return figure


def _histogram(axes: Axes, both: Mapping[Mode, Vector], *, logarithm: bool) -> list[Shown]:
    seen = np.concatenate(list(both.values()))
    seen = seen[np.isfinite(seen)]
    edges = (np.geomspace if logarithm else np.linspace)(seen.min(), seen.max(), _BINS + 1)
    shown: list[Shown] = []
    for mode, values in both.items():
        style = {"color": _COLOURS[mode], "alpha": 0.75}
        axes.hist(values[np.isfinite(values)], edges.tolist(), **style)
        shown.append((Patch(**style), MODES[mode]))
    if logarithm:
        logarithmic(axes, "x")
    finish(axes)
    return shown


def _against(axes: Axes, model: Vector, zoh: Vector, *, logarithm: bool) -> None:
    """Draw one dot per draw; both loops are equal on the diagonal line."""
    finite = np.isfinite(model) & np.isfinite(zoh)
    model, zoh = model[finite], zoh[finite]
    low, high = min(model.min(), zoh.min()), max(model.max(), zoh.max())
    axes.plot((low, high), (low, high), color=INK, linewidth=0.9)
    axes.plot(model, zoh, "o", color=_DOT, markersize=2.2, alpha=0.5, markeredgewidth=0)
    if logarithm:
        logarithmic(axes, "x")
        logarithmic(axes, "y")
    finish(axes)
