"""The figure of a soak: private memory over time, per process."""

from matplotlib.figure import Figure

from benchmarks.soak.flat import warm_up_s
from benchmarks.soak.result import Result
from cosim.output import palette
from cosim.output.report.axes import (
    finish,
    head_in,
    layout,
    line,
    panel_width_in,
    place,
)
from cosim.output.report.figure_style import printed, styled

_HEIGHT_IN, _GAP_IN = 0.95, 0.3


@styled
def memory_figure(result: Result) -> Figure:
    """Plot private memory minus its value at the end of the warm-up, in KiB, over the run."""
    import numpy as np

    roles = list(result.watched)
    space, head = layout(), head_in(())
    whole_in = head + len(roles) * (_HEIGHT_IN + _GAP_IN) - _GAP_IN + space.below_in
    figure = Figure(figsize=(space.width_in, whole_in))
    for i, role in enumerate(roles):
        watched = result.watched[role]
        top_in = head + i * (_HEIGHT_IN + _GAP_IN)
        axes = place(figure, space.left_in, top_in, panel_width_in(), _HEIGHT_IN)
        at_s = np.array(watched.at_s)
        kib = np.array([sample.uss_kib for sample in watched.samples])
        warm_s = warm_up_s(watched.length_s)
        began = int(np.searchsorted(at_s, warm_s))
        base = float(kib[min(began, len(kib) - 1)])
        axes.axvspan(0.0, warm_s, color="0.93", linewidth=0)
        colour = palette.PROCESSES.get(role, palette.SERIES[5 if role == "recorder" else 4])
        line(axes, at_s, kib - base, color=printed(colour))
        judged = kib[began:] - base if began < len(kib) else kib - base
        low, high = min(float(judged.min()), -128.0), max(float(judged.max()), 1024.0)
        axes.set_ylim(low - 0.05 * (high - low), high + 0.05 * (high - low))
        axes.set_ylabel(f"{role}\n[KiB]")
        finish(axes, at_s)
        last = i == len(roles) - 1
        axes.tick_params(labelbottom=last)
        if last:
            axes.set_xlabel("wall time [s]")
        if i == 0:
            axes.set_title(
                f"{result.name}: private memory since the warm-up (grey); 1 MiB is allowed"
            )
    figure.align_ylabels()
    return figure
