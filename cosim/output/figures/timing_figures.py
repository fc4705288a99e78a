"""The figures of a loop's times: between events, latencies, lateness of its processes, their clocks."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from cosim.analysis.summary.loop_statistics import latency_us, lateness_parts
from cosim.analysis.summary.quantiles import QuantileSketch
from cosim.output.curves import DASHES, Curve
from cosim.output.figures import palette
from cosim.output.figures.axes_parts import (
    TIME,
    draw_bars,
    draw_curve,
    draw_line,
    draw_marks,
    finite,
    histogram,
    limit_to,
    rgb,
    whole_numbers,
)
from cosim.output.figures.page_figure import PageFigure, one_panel
from cosim.output.figures.palette import CONTROLLER, SENSOR, THRESHOLD, Colour
from cosim.output.figures.panels import Panels
from cosim.record.align import Reals
from cosim.record.run_record import RunRecord
from netem.core.clock import NS_PER_S
from noack.protocol.roles import LOOP_ROLES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_RANKS = 120
"""Points of a distribution, with a logarithmic and again with a linear spacing."""
_SHORTEST_US = 0.1  # a logarithmic axis has no zero


def _times_figure(
    name: str, title: str, label: str, until_s: float, t_s: Reals, values: Reals, colour: Colour,
    bounds: Sequence[Curve] = (), **texts: str,
) -> PageFigure:  # fmt: skip
    """Return a figure of values over time, and their histogram on the same logarithmic axis."""

    def draw(figure: "Figure") -> list[Panels]:
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set(yscale="log", title=title, ylabel=label, xlabel=TIME, xlim=(0.0, t_s.max(initial=until_s)))
        limit_to(axes, np.concatenate([values, *(bound.values for bound in bounds)]))
        counted = figure.add_axes((0, 0, 1, 1), sharey=axes)
        edges, counts = histogram(values)
        draw_bars(counted, edges, counts, colour, share=0.9, is_horizontal=True)
        for bound in bounds:
            draw_curve(axes, bound, label=bound.name)
            if len(bound.values):
                style = bound.style
                counted.axhline(
                    bound.values.min(), color=rgb(style.colour), linewidth=1.6, dashes=style.dash or (1, 0)
                )
        draw_marks(axes, t_s, values, colour, markeredgewidth=0.0)
        counted.set_xlabel("count")
        counted.tick_params(which="both", labelleft=False)
        whole_numbers(counted, "x")
        return [Panels([axes, counted], 2.1, beside_in=2.0)]

    return PageFigure(name=name, draw_panels=draw, **texts)


def inter_event_figure(record: RunRecord, bounds: Sequence[Curve]) -> PageFigure:
    """Return the figure of the times between successive events."""
    event_s, horizon_s = record.events()["t_ns"] / NS_PER_S, record.scenario.horizon_s
    interval_s = np.diff(event_s)
    shortest = f", the shortest {interval_s.min():.3g} s" if len(interval_s) else ""
    return _times_figure(
        "inter-event", "Inter-event times", "inter-event time [s]",
        horizon_s, event_s[1:], interval_s, SENSOR, bounds,
        caption="Inter-event times, over time and as a histogram."
        + (" Dashed: claimed bounds." if bounds else ""),
        description=f"Inter-event times on a logarithmic axis{shortest}.",
    )  # fmt: skip


def latency_figure(record: RunRecord) -> PageFigure:
    """Return the figure of the wall time from each event to the update of the controller."""
    event_ns, taken_us = latency_us(record)
    return _times_figure(
        "latency", "Sensor-to-controller latency", "latency [wall µs]",
        record.scenario.horizon_s, event_ns / NS_PER_S, taken_us, CONTROLLER,
        caption="Sensor-to-controller latency: wall time from the event to the controller's update.",
        description=f"Latencies of {len(taken_us)} updates, the longest {largest_text(taken_us)} µs.",
    )  # fmt: skip


def largest_text(values: Reals) -> str:
    """Return the largest finite value as text."""
    values = values[np.isfinite(values)]
    return f"{values.max():.3g}" if len(values) else "unknown"


def lateness_figure(record: RunRecord) -> PageFigure:
    """Return the figure of the share of each process's steps with at least a given lateness."""
    scenario = record.scenario
    late_us = {role: QuantileSketch.of(lateness_parts(record, role)) for role in LOOP_ROLES}
    largest = {role: values.quantiles(1.0)[0] for role, values in late_us.items()}
    longest = [f"{role} {'unknown' if most is None else f'{most:.3g}'} µs" for role, most in largest.items()]

    def draw(axes: "Axes") -> None:
        axes.set(
            title="Lateness", xscale="log", xlabel="lateness [wall µs]",
            yscale="log", ylabel="share of steps at least as late",
        )  # fmt: skip
        for i, (role, values) in enumerate(late_us.items()):
            draw_line(
                axes, *later_than(values), palette.PROCESSES[role], DASHES[i % len(DASHES)],
                label=role, linewidth=1.8, drawstyle="steps-pre",
            )  # fmt: skip
        period_us = scenario.timing.plant_period_ns / (1e3 * scenario.speed)
        axes.axvline(period_us, color=rgb(THRESHOLD), label="one period", linewidth=1.2, dashes=(4, 3))

    return one_panel(
        "lateness",
        2.5,
        draw,
        caption="Share of a process's steps with at least this lateness. Lateness is measured "
        "from the deadline (plant, controller), the time of the measurement (sensor), or the "
        "arrival of the datagram at the socket (network).",
        description=f"Complementary distribution of lateness on logarithmic axes; "
        f"maximum: {', '.join(longest)}.",
    )


def later_than(values: QuantileSketch) -> tuple[Reals, Reals]:
    """Return values in ascending order, and for each the share of values at least as large."""
    k = values.count
    if not k:
        return np.zeros(0), np.zeros(0)
    # k values are at least as large as the k-th largest. The same number of points in each decade
    # of shares, and linearly spaced ones, which resolve the median.
    rank = np.concatenate([np.geomspace(1, k, _RANKS), np.linspace(1, k, _RANKS)])
    rank = np.unique(rank.round().astype(np.intp))[::-1]
    return np.maximum(finite(values.largest(rank)), _SHORTEST_US), rank / k
