"""The figures of a loop's times: between events, latencies, lateness of its processes, their clocks."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.summary.loop_statistics import latency_us, lateness_parts
from cosim.analysis.summary.quantiles import QuantileSketch
from cosim.output.curves import DASHES
from cosim.output.figures import palette
from cosim.output.figures.figure_description import (
    TIME,
    Axis,
    Bars,
    FigureDescription,
    Item,
    Line,
    Marks,
    Panel,
    Rule,
    finite,
    histogram,
    one_panel,
)
from cosim.output.figures.palette import CONTROLLER, SENSOR, THRESHOLD
from cosim.record.align import Reals
from cosim.record.run_record import RunRecord
from noack.core.clock import NS_PER_S
from noack.protocol.roles import LOOP_ROLES

Flags = NDArray[np.bool_]
_RANKS = 120
"""Points of a distribution, with a logarithmic and again with a linear spacing."""
_SHORTEST_US = 0.1  # a logarithmic axis has no zero


def _times_figure(
    name: str, title: str, dots: Marks, label: str, until_s: float, bounds: Sequence[Line] = ()
) -> FigureDescription:
    """Describe values over time, and their histogram on the same logarithmic axis."""
    edges, counts = histogram(dots.y)
    bars = Bars(edges=edges, heights=counts, colour=dots.colour, share=0.9, horizontal=True)
    least = [
        Rule(at=float(line.y.min()), colour=line.colour, dash=line.dash) for line in bounds if len(line.y)
    ]
    counted = Axis(label="count", whole=True)
    panel = Panel(
        title=title,
        items=[*bounds, dots],
        x=Axis(label=TIME, ends=(0.0, float(dots.x.max(initial=until_s)))),
        y=Axis(label=label, logarithmic=True),
        beside=Panel(items=[bars, *least], x=counted, y=Axis(logarithmic=True)),
    )
    return one_panel(name, panel, 2.1)


def inter_event_figure(record: RunRecord, bounds: Sequence[Line]) -> FigureDescription:
    """Describe the times between successive events."""
    event_s, horizon_s = record.events()["t_ns"] / NS_PER_S, record.scenario.horizon_s
    interval_s, title = np.diff(event_s), "Inter-event times"
    dots = Marks(x=event_s[1:], y=interval_s, colour=SENSOR, framed=True)
    shortest = f", the shortest {interval_s.min():.3g} s" if len(interval_s) else ""
    label = "inter-event time [s]"
    return _times_figure("inter-event", title, dots, label, horizon_s, bounds).captioned(
        "Inter-event times, over time and as a histogram." + (" Dashed: claimed bounds." if bounds else ""),
        f"Inter-event times on a logarithmic axis{shortest}.",
    )


def latency_figure(record: RunRecord) -> FigureDescription:
    """Describe the wall time from each event to the update of the controller."""
    event_ns, taken_us = latency_us(record)
    dots = Marks(x=event_ns / NS_PER_S, y=taken_us, colour=CONTROLLER, framed=True)
    title, horizon_s = "Sensor-to-controller latency", record.scenario.horizon_s
    return _times_figure("latency", title, dots, "latency [wall µs]", horizon_s).captioned(
        "Sensor-to-controller latency: wall time from the event to the controller's update.",
        f"Latencies of {len(taken_us)} updates, the longest {largest_text(taken_us)} µs.",
    )


def largest_text(values: Reals) -> str:
    """Return the largest finite value as text."""
    values = values[np.isfinite(values)]
    return f"{values.max():.3g}" if len(values) else "unknown"


def lateness_figure(record: RunRecord) -> FigureDescription:
    """Describe the share of each process's steps with at least a given lateness."""
    scenario, items, longest = record.scenario, list[Item](), list[str]()
    for i, role in enumerate(LOOP_ROLES):
        late_us = QuantileSketch.of(lateness_parts(record, role))
        most = late_us.quantiles(1.0)[0]
        longest.append(f"{role} {'unknown' if most is None else f'{most:.3g}'} µs")
        x, y = later_than(late_us)
        colour, dash = palette.PROCESSES[role], DASHES[i % len(DASHES)]
        items.append(Line(x=x, y=y, label=role, colour=colour, steps="pre", width=1.8, dash=dash))
    period_us = scenario.timing.plant_period_ns / (1e3 * scenario.speed)
    period = Rule(at=period_us, colour=THRESHOLD, label="one period", vertical=True, width=1.2)
    panel = Panel(
        title="Lateness",
        items=[*items, replace(period, dash=(4, 3))],
        x=Axis(label="lateness [wall µs]", logarithmic=True),
        y=Axis(label="share of steps at least as late", logarithmic=True),
    )
    return one_panel("lateness", panel, 2.5).captioned(
        "Share of a process's steps with at least this lateness. Lateness is measured "
        "from the deadline (plant, controller), the time of the measurement (sensor), or the "
        "arrival of the datagram at the socket (network).",
        f"Complementary distribution of lateness on logarithmic axes; maximum: {', '.join(longest)}.",
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
