"""The figures of one loop, from plain arrays: times in seconds, one row per sample.

Arrays may have any length, including 0, and values that are not finite. Norms are those of the
run's trigger, ‖v‖ = ‖W v‖₂. In every figure, grey is the plant, blue the sensor, orange the
controller; dashed curves are certified bounds.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.fidelity import Fidelity
from cosim.analysis.value_reduction import QuantileSketch
from cosim.output import palette
from cosim.output.figure_description import (
    DASHES,
    TIME,
    Axis,
    Bars,
    FigureDescription,
    Item,
    Line,
    Marks,
    Panel,
    Row,
    Rule,
    finite,
    histogram,
    one_panel,
    plain,
    series_colour,
    time_axis,
)
from cosim.output.palette import CONTROLLER, FORCED, LOST, PLANT, SENSOR, THRESHOLD, Colour
from cosim.record.align import Reals

Flags = NDArray[np.bool_]

_STATES_NARROWEST_IN, _LOSSES_NARROWEST_IN, _LOSSES_WIDEST_IN = 1.7, 2.2, 5.0
_MOST_STATES = 16
_LONGEST_TITLE = 40
_DECADES = 6
_RANKS = 120
_SHORTEST_US = 0.1  # a logarithmic axis has no zero
_MOST_LABELS = 12


def states_figure(
    *,
    mode: Literal["model", "zoh"],
    t_s: Reals,
    x: Reals,
    x_s: Reals,
    x_c: Reals,
    state_names: Sequence[str],
    broadcast_s: Reals,
    dropped: Flags,
    received_s: Reals,
    forced: Flags,
    title: str = "",
    x_hat: Reals | None = None,
) -> FigureDescription:
    """States, and broadcasting and receiving intervals: the paper's Fig. 2 and 3.

    Args:
        mode: ``model`` is the paper's MB-ET (Fig. 2), ``zoh`` its ZOH-ET (Fig. 3).
        t_s: (k,) times of the samples.
        x: (k, n) the plant's state.
        x_s: (k, n) the sensor's model.
        x_c: (k, n) the controller's model; NaN where unknown.
        state_names: n names; the first 16 states are drawn.
        broadcast_s: (e,) times t_i of all transmissions.
        dropped: (e,) whether the network lost the transmission.
        received_s: (d,) times t_i* of the transmissions that the controller received.
        forced: (d,) whether the guarantee forced the delivery.
        title: title of the run, shown after "MB-ET" or "ZOH-ET".
        x_hat: (k, n) the sensor's estimate of x; None if it measures x exactly.
    """
    n = len(state_names)
    drawn = min(n, _MOST_STATES)
    panels = [
        Panel(
            items=_state(
                t_s, x[:, i], x_s[:, i], x_c[:, i], None if x_hat is None else x_hat[:, i]
            ),
            x=time_axis(t_s),
            y=Axis(label=plain(state_names[i])),
            legend=() if i else None,
        )
        for i in range(drawn)
    ]
    columns = drawn if drawn <= 3 else 2 if drawn == 4 else 3 if drawn <= 12 else 4
    height_in = 1.45 if drawn <= 2 * columns else 1.15
    sent, received = _intervals(broadcast_s), _intervals(received_s)
    highest = 1.05 * max(np.nanmax(np.append(finite(one), 0.0)) for one in (sent, received)) or None
    interval = Axis(label="interval [s]", ends=(0.0, highest))
    head = "MB-ET" if mode == "model" else "ZOH-ET"
    note = f" ({drawn} of {n} states)" if drawn < n else ""
    return FigureDescription(
        name="states",
        heading=": ".join(filter(None, (head, plain(title, _LONGEST_TITLE)))) + note,
        rows=[
            Row(panels=panels, height_in=height_in, columns=columns, common="x",
                narrowest_in=_STATES_NARROWEST_IN),
            Row(panels=[Panel(
                title="Broadcasting intervals", y=interval, x=time_axis(t_s, numbers=False),
                items=_broadcasts(broadcast_s, sent, dropped),
            )], height_in=1.2),
            Row(panels=[Panel(
                title="Receiving intervals", y=interval, x=time_axis(t_s),
                items=_receptions(received_s, received, forced, broadcast_s[dropped]),
            )], height_in=1.2),
        ],
    )  # fmt: skip


def _state(t_s: Reals, x: Reals, x_s: Reals, x_c: Reals, x_hat: Reals | None) -> list[Item]:
    """Describe one state; curves in front are thinner, so that equal curves stay visible."""
    estimate = [] if x_hat is None else [
        Line(x=t_s, y=x_hat, label=r"$\hat{x}$ sensor", colour=SENSOR, width=1.0, dash=(1, 1),
             order=2.3)
    ]  # fmt: skip
    return [
        Line(x=t_s, y=x, label="$x$ plant", colour=PLANT, width=4.2),
        *estimate,
        Line(x=t_s, y=x_s, label="$x_s$ sensor", colour=SENSOR, order=2.2),
        Line(x=t_s, y=x_c, label="$x_c$ controller", colour=CONTROLLER, width=2.4, order=2.1),
    ]


def _intervals(t_s: Reals) -> Reals:
    """Return the times since the previous event, NaN for the first, (k,)."""
    return np.diff(t_s, prepend=np.nan)


def _broadcasts(t_s: Reals, interval_s: Reals, dropped: Flags) -> list[Item]:
    return [
        Marks(x=t_s[~dropped], y=interval_s[~dropped], label="sent", colour=SENSOR, stems=SENSOR),
        Marks(x=t_s[dropped], y=interval_s[dropped], label="sent, lost", colour=LOST, marker="x",
              size=6.5, stroke=1.8, stems=SENSOR),
    ]  # fmt: skip


def _receptions(t_s: Reals, interval_s: Reals, forced: Flags, dropped_s: Reals) -> list[Item]:
    return [
        Marks(x=t_s[~forced], y=interval_s[~forced], label="received", colour=CONTROLLER,
              stems=CONTROLLER),
        Marks(x=t_s[forced], y=interval_s[forced], label="received, forced", colour=FORCED,
              marker="D", size=6.0, stems=CONTROLLER),
        Marks(x=dropped_s, y=np.zeros(len(dropped_s)), label="lost", colour=LOST, marker="x",
              order=3),
    ]  # fmt: skip


def error_figure(
    t_s: Reals, e_s_norm: Reals, threshold: Reals, e_c_norm: Reals, bounds: Sequence[Line] = ()
) -> FigureDescription:
    """‖e_s‖ with its threshold, and ‖e_c‖ with its bounds, on a logarithmic axis.

    Args:
        t_s: (k,) times of the samples.
        e_s_norm: (k,) ‖x_s − x‖ before a reset, as the trigger tested it.
        threshold: (k,) threshold of the trigger.
        e_c_norm: (k,) ‖x_c − x‖; NaN where unknown.
        bounds: certified bounds on ‖e_c‖.
    """
    lines = [
        Line(x=t_s, y=e_c_norm, label=r"$\|e_c\|$ controller", colour=CONTROLLER, width=2.6),
        Line(x=t_s, y=e_s_norm, label=r"$\|e_s\|$ sensor", colour=SENSOR, width=1.1),
        Line(x=t_s, y=threshold, label="threshold", colour=THRESHOLD, width=1.8),
    ]
    return _norms("errors", "Error norms", lines, bounds, 2.7)


def state_norm_figure(t_s: Reals, x_norm: Reals, bounds: Sequence[Line] = ()) -> FigureDescription:
    """‖x‖, (k,) at times (k,), with its bounds, on a logarithmic axis."""
    line = Line(x=t_s, y=x_norm, label=r"$\|x\|$ plant", colour=PLANT, width=2.4)
    return _norms("state-norm", "Norm of the state", [line], bounds, 2.1)


def fidelity_figure(fidelity: Fidelity) -> FigureDescription:
    """Change of x by each effect, over time: ‖x_(with the effect) − x_(without)‖."""
    lines = [
        Line(x=fidelity.t_s, y=norms, label=stage.name, colour=series_colour(i), dash=DASHES[i],
             width=1.6)
        for i, (stage, norms) in enumerate(zip(fidelity.stages, fidelity.stage_norms, strict=True))
    ]  # fmt: skip
    title = f"{plain(fidelity.scenario, _LONGEST_TITLE)}: effects on x"
    return _norms("fidelity", title, lines, (), 2.7)


def _norms(
    name: str, title: str, lines: Sequence[Line], bounds: Sequence[Line], height_in: float,
) -> FigureDescription:  # fmt: skip
    """Describe a figure of norms; its axis is limited: resets fall to rounding errors."""
    measured = np.concatenate([line.y for line in lines])
    y = Axis(label="norm", logarithmic=True, about=measured, decades=_DECADES)
    panel = Panel(title=title, items=[*lines, *bounds], x=time_axis(lines[0].x), y=y)
    return one_panel(name, panel, height_in)


def input_figure(
    t_s: Reals, u: Reals, input_names: Sequence[str], title: str = "Control input"
) -> FigureDescription:
    """Control inputs; each is held until the next.

    Args:
        t_s: (k,) times from which each input is held.
        u: (k, m) inputs.
        input_names: m names.
        title: of the figure.
    """
    m = len(input_names)
    lines = [
        # Inputs often coincide: the first ones are wider, and stay visible under the last.
        Line(x=t_s, y=u[:, i], label=plain(name) or f"u_{i + 1}", colour=series_colour(i),
             dash=DASHES[i // len(palette.SERIES) % len(DASHES)], steps="post",
             width=1.3 + 2.6 * (m - 1 - i) / m)
        for i, name in enumerate(input_names)
    ]  # fmt: skip
    panel = Panel(title=title, items=lines, x=time_axis(t_s), y=Axis(label="input"))
    return one_panel("input", panel, 1.7)


def inter_event_figure(
    broadcast_s: Reals, bounds: Sequence[Line] = (), until_s: float | None = None
) -> FigureDescription:
    """Inter-event times t_i − t_{i−1} over time, with a histogram.

    Args:
        broadcast_s: (e,) times t_i of all transmissions.
        bounds: lower bounds of the inter-event time, certified or from the paper's formula.
        until_s: end of the time axis; by default the last event.
    """
    y = Axis(label="inter-event time [s]", logarithmic=True)
    dots = _dots(broadcast_s[1:], np.diff(broadcast_s), SENSOR)
    return _over_time("inter-event", "Inter-event times", dots, y, until_s, bounds)


def latency_figure(
    t_s: Reals, latency_us: Reals, until_s: float | None = None
) -> FigureDescription:
    """Sensor-to-controller latency over time, with a histogram.

    Args:
        t_s: (d,) event times of the updates that arrived.
        latency_us: (d,) wall µs from the event to the controller's update.
        until_s: end of the time axis; by default the last event.
    """
    y = Axis(label="latency [wall µs]", logarithmic=True)
    dots = _dots(t_s, latency_us, CONTROLLER)
    return _over_time("latency", "Sensor-to-controller latency", dots, y, until_s)


def _dots(t_s: Reals, values: Reals, colour: Colour) -> Marks:
    return Marks(x=t_s, y=values, colour=colour, framed=True)


def _over_time(
    name: str, title: str, dots: Marks, y: Axis, until_s: float | None,
    bounds: Sequence[Line] = (),
) -> FigureDescription:  # fmt: skip
    """Describe values over time, and their histogram on the same logarithmic axis."""
    edges, counts = histogram(dots.y)
    bars = Bars(edges=edges, heights=counts, colour=dots.colour, share=0.9, horizontal=True)
    ends = (None, None) if until_s is None else (0.0, float(dots.x.max(initial=until_s)))
    least = [
        Rule(at=float(line.y.min()), colour=line.colour, dash=line.dash)
        for line in bounds if len(line.y)
    ]  # fmt: skip
    counted = Axis(label="count", whole=True)
    panel = Panel(
        title=title, items=[*bounds, dots], x=Axis(label=TIME, ends=ends), y=y,
        beside=Panel(items=[bars, *least], x=counted, y=Axis(logarithmic=True)),
    )  # fmt: skip
    return one_panel(name, panel, 2.1)


class LossPanel(NamedTuple):
    """One histogram of whole numbers, with the largest number that the guarantee allows."""

    title: str
    what: str
    """Label of the horizontal axis."""
    counted: str
    """Label of the vertical axis."""
    values: NDArray[np.int64]
    """(k,)"""
    limit: int | None


def loss_figure(panels: Sequence[LossPanel]) -> FigureDescription:
    """The losses that occurred, beside what the guarantee allows: histograms side by side."""
    row = Row(
        panels=[*map(_loss_panel, panels)], height_in=1.9, narrowest_in=_LOSSES_NARROWEST_IN,
        widest_in=_LOSSES_WIDEST_IN,
    )  # fmt: skip
    return FigureDescription(name="losses", rows=[row])


def _loss_panel(panel: LossPanel) -> Panel:
    counts = Counter(panel.values.tolist())
    numbers = sorted(counts)
    limit = numbers[-1] if panel.limit is None and numbers else panel.limit or 0
    low, high = min([1, *numbers]), max([limit, *numbers])
    bars = Bars(
        edges=np.arange(low, high + 2) - 0.5,
        heights=np.array([counts[number] for number in range(low, high + 1)], np.float64),
        colour=LOST, share=0.8, numbers=len(numbers) <= _MOST_LABELS,
    )  # fmt: skip
    rule = [] if panel.limit is None else [
        Rule(at=panel.limit + 0.5, colour=palette.CERTIFIED, vertical=True)
    ]  # fmt: skip
    return Panel(
        title=panel.title,
        items=[bars, *rule],
        x=Axis(label=panel.what, ends=(low - 0.6, high + 0.9), whole=True, grid=False),
        y=Axis(label=panel.counted, whole=True),
        empty="no loss",
    )


def lateness_figure(
    lateness_us: Mapping[str, QuantileSketch], period_us: float | None = None
) -> FigureDescription:
    """Share of steps with at least a given lateness, per process.

    Args:
        lateness_us: by process, the lateness of its steps in wall µs.
        period_us: the plant's period in wall µs, beyond which a step counts as late.
    """
    items: list[Item] = []
    for i, (process, late_us) in enumerate(lateness_us.items()):
        x, y = _later_than(late_us)
        colour = palette.PROCESSES.get(process, series_colour(i))
        items.append(Line(x=x, y=y, label=plain(process), colour=colour, steps="pre", width=1.8,
                          dash=DASHES[i % len(DASHES)]))  # fmt: skip
    if period_us is not None:
        items.append(Rule(at=period_us, colour=THRESHOLD, label="one period", vertical=True,
                          width=1.2, dash=(4, 3)))  # fmt: skip
    panel = Panel(
        title="Lateness",
        items=items,
        x=Axis(label="lateness [wall µs]", logarithmic=True),
        y=Axis(label="share of steps at least as late", logarithmic=True),
    )
    return one_panel("lateness", panel, 2.5)


def _later_than(values: QuantileSketch) -> tuple[Reals, Reals]:
    """Return values in ascending order, and for each the share of values at least as large."""
    k = values.count
    if not k:
        return np.zeros(0), np.zeros(0)
    # k values are at least as large as the k-th largest. The same number of points in each decade
    # of shares, and linearly spaced ones, which resolve the median.
    rank = np.concatenate([np.geomspace(1, k, _RANKS), np.linspace(1, k, _RANKS)])
    rank = np.unique(rank.round().astype(np.intp))[::-1]
    return np.maximum(finite(values.largest(rank)), _SHORTEST_US), rank / k


class ClockErrors(NamedTuple):
    """Bounds of the error of a process's clock: k comparisons with the recorder's clock."""

    t_s: Reals
    """(k,)"""
    error_us: Reals
    """(k,) wall µs; NaN: the bound was lost."""

    @property
    def lost(self) -> Flags:
        """(k,) whether the bound was lost."""
        return np.isnan(self.error_us)

    @property
    def largest_us(self) -> float | None:
        """The largest known bound; None without one."""
        known = self.error_us[~self.lost]
        return float(known.max()) if len(known) else None


def clock_figure(
    errors: Mapping[str, ClockErrors], allowed_us: float, until_s: float | None = None
) -> FigureDescription:
    """Bound of the error of each process's clock over time; it has a gap while it is lost.

    Args:
        errors: by process.
        allowed_us: largest bound with which claims hold; crosses at this height show where a bound
            was lost.
        until_s: end of the time axis; by default the last comparison.
    """
    last_s = max((one.t_s.max(initial=0.0) for one in errors.values()), default=0.0)
    last_s = last_s if until_s is None else until_s
    lines: list[Item] = []
    crosses: list[Item] = []
    for i, (process, one) in enumerate(errors.items()):
        keep, colour = one.t_s <= last_s, palette.PROCESSES[process]
        t_s, error_us, lost = one.t_s[keep], one.error_us[keep], one.lost[keep]
        # The curves often coincide: the first ones are wider, and stay visible under the last.
        width = 1.3 + 1.2 * (len(errors) - 1 - i)
        lines.append(Line(x=t_s, y=error_us, label=process, colour=colour, width=width,
                          order=2 + 0.1 * i))  # fmt: skip
        began = lost & ~np.append(False, lost[:-1])
        crosses.append(Marks(x=t_s[began], y=np.full(int(began.sum()), allowed_us), colour=colour,
                             marker="x", size=9.0, stroke=2.0, order=2 + 0.1 * i))  # fmt: skip
    limit = Rule(at=allowed_us, colour=THRESHOLD, label="allowed", width=1.2, dash=(4, 3))
    unknown = all(one.largest_us is None for one in errors.values())
    ends = (allowed_us / 10, allowed_us * 10) if unknown else (None, None)
    panel = Panel(
        title="Clocks",
        items=[*lines, *crosses, limit],
        x=time_axis(np.array([0.0, last_s])),
        y=Axis(label="bound of error [wall µs]", logarithmic=True, ends=ends),
    )
    return one_panel("clocks", panel, 1.9)
