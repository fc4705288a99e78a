"""The figures of the page: the paper's Fig. 2 and 3 for one draw, and all draws together."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cosim.output import palette
from cosim.output.figure_description import (
    Axis,
    Bars,
    FigureDescription,
    Line,
    Marks,
    Panel,
    Row,
    series_colour,
)
from cosim.output.signal_figures import states_figure
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
_ABOVE_IN, _BELOW_IN, _LEFT_IN = 1.6, 2.0, 0.78
_COLOURS: Mapping[Mode, palette.Colour] = {"model": series_colour(2), "zoh": series_colour(3)}
_INK = (27, 31, 36)


def draw_figure(run: ContinuousRun, resolved: Scenario, draw: int) -> FigureDescription:
    """Describe states, broadcasting and receiving intervals of one loop of a draw."""
    shown = run.event_s <= SHOWN_S
    samples = run.at(np.linspace(0.0, SHOWN_S, round(SHOWN_S / _STEP_S) + 1))
    fates = _fates(resolved, int(shown.sum()))
    event_s = run.event_s[shown]
    return states_figure(
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


def ensemble_figure(results: Results) -> FigureDescription:
    """Describe the distributions over the draws; below, both loops of each draw as a point."""
    above, below = [], []
    for name, title, unit, logarithm in _PANELS:
        both: dict[Mode, Vector] = {mode: results.column(f"{mode}.{name}") for mode in MODES}
        above.append(_histogram(title, unit, both, logarithm=logarithm))
        below.append(_against(unit, both["model"], both["zoh"], logarithm=logarithm))
    above = [replace(panel, legend=() if i else None) for i, panel in enumerate(above)]
    return FigureDescription(
        name="ensemble",
        heading=f"{results.count():,} draws, each with MB-ET and ZOH-ET",
        rows=[
            Row(panels=above, height_in=_ABOVE_IN, left_in=_LEFT_IN),
            Row(panels=below, height_in=_BELOW_IN, left_in=_LEFT_IN),
        ],
    )


def _histogram(title: str, unit: str, both: Mapping[Mode, Vector], *, logarithm: bool) -> Panel:
    seen = np.concatenate(list(both.values()))
    seen = seen[np.isfinite(seen)]
    edges = (np.geomspace if logarithm else np.linspace)(seen.min(), seen.max(), _BINS + 1)
    bars = [
        Bars(edges=edges, colour=_COLOURS[mode], opacity=0.75, label=MODES[mode],
             heights=np.histogram(values[np.isfinite(values)], edges)[0].astype(np.float64))
        for mode, values in both.items()
    ]  # fmt: skip
    x, y = Axis(label=f"{title}, {unit}", logarithmic=logarithm), Axis(label="draws")
    return Panel(items=bars, x=x, y=y)


def _against(unit: str, model: Vector, zoh: Vector, *, logarithm: bool) -> Panel:
    """Describe one dot per draw; both loops are equal on the diagonal line."""
    finite = np.isfinite(model) & np.isfinite(zoh)
    model, zoh = model[finite], zoh[finite]
    ends = np.array([min(model.min(), zoh.min()), max(model.max(), zoh.max())])
    diagonal = Line(x=ends, y=ends, colour=_INK, width=0.9)
    dots = Marks(x=model, y=zoh, colour=palette.PLANT, size=2.2, opacity=0.5, stroke=0.0,
                 reduced=False)  # fmt: skip
    return Panel(
        items=[diagonal, dots],
        x=Axis(label=f"MB-ET, {unit}", logarithmic=logarithm),
        y=Axis(label=f"ZOH-ET, {unit}", logarithmic=logarithm),
    )
