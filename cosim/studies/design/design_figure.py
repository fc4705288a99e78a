"""The figure of a design: transmissions against the quantile of the settling times."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cosim.output import palette
from cosim.output.report.axes import finish, legend, logarithmic, plain, single
from cosim.output.report.figure_style import printed, styled
from cosim.studies.design.design_result import DesignResult

_HEIGHT_IN = 3.8
_MARKERS = "os^Dv<>PX"


@styled
def trade_off(found: DesignResult) -> Figure:
    """Draw all tried candidates, the trade-off curve, the limit and the chosen candidate."""
    names = [f"W {family.name}" for family in found.space.families]
    star_name = "the choice" if found.feasible else "the closest"
    labels = [*names, "trade-off", "limit", star_name]
    figure, (axes,) = single(_HEIGHT_IN, labels)
    shown = []
    for i, name in enumerate(names):
        colour = printed(palette.SERIES[i % len(palette.SERIES)])
        own = [t.measured for t in found.trials if t.candidate.family == i]
        own = [m for m in own if np.isfinite(m.settling_s)]
        axes.plot(
            [m.transmissions for m in own], [m.settling_s for m in own], color=colour,
            linestyle="none", marker=_MARKERS[i % len(_MARKERS)], markersize=3.5, alpha=0.5,
        )  # fmt: skip
        shown.append(
            (Line2D([], [], color=colour, marker=_MARKERS[i % len(_MARKERS)], linestyle="none"),
             plain(name, 24))
        )  # fmt: skip
    (front,) = axes.plot(
        [t.measured.transmissions for t in found.front],
        [t.measured.settling_s for t in found.front],
        drawstyle="steps-post", color=printed(palette.NETWORK), linewidth=1.4,
    )  # fmt: skip
    limit = axes.axhline(
        found.limits.settling_s, color=printed(palette.CERTIFIED), linestyle=(0, (6, 2))
    )
    best = found.fresh
    if np.isfinite(best.settling_s):
        high_s = best.settling_high_s if np.isfinite(best.settling_high_s) else best.settling_s
        axes.errorbar(
            [best.transmissions], [best.settling_s],
            yerr=[[best.settling_s - best.settling_low_s], [high_s - best.settling_s]],
            xerr=[best.halfwidth], color=printed(palette.LOST), marker="*", markersize=12,
        )  # fmt: skip
    star = Line2D([], [], color=printed(palette.LOST), marker="*", linestyle="none")
    shown += [(front, labels[-3]), (limit, labels[-2]), (star, labels[-1])]
    axes.set(
        xlabel="transmissions (mean)",
        ylabel=f"settling time, {100 * found.limits.quantile:g} % quantile [s]",
    )
    if any(np.isfinite(trial.measured.settling_s) for trial in found.trials):
        logarithmic(axes, "x")
    legend(axes, shown)
    finish(axes)
    return figure
