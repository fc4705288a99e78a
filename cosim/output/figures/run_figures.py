"""The figures of one loop, from its record.

Records may have any length, including 0, and values that are not finite. Norms are those of the
run's trigger, ‖v‖ = ‖W v‖₂. In every figure, grey is the plant, blue the sensor, orange the
controller; dashed curves are certified bounds.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import groupby
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.claims.claim_evaluation import claims_of
from cosim.analysis.summary.output_statistics import output_distances
from cosim.output.curves import (
    DASHED,
    BoundKind,
    Curve,
    Quantity,
    bound_curves,
    error_curves,
    input_curves,
    norm_curve,
    output_curves,
    state_curves,
    transmission_curves,
)
from cosim.output.figures import palette
from cosim.output.figures.axes_parts import (
    draw_bars,
    draw_curve,
    draw_marks,
    finite,
    label_text,
    limit_decades,
    mark_empty,
    rgb,
    set_times,
    whole_numbers,
)
from cosim.output.figures.page_figure import PageFigure, one_panel
from cosim.output.figures.palette import CONTROLLER, FORCED, LOST, SENSOR
from cosim.output.figures.panels import Panels, columns
from cosim.output.figures.timing_figures import (
    inter_event_figure,
    largest_text,
    latency_figure,
    lateness_figure,
)
from cosim.record.align import AlignedRun, Reals, aligned_parts
from cosim.record.decimation import decimate_all
from cosim.record.run_events import packet_outcomes, reference_in_run
from cosim.record.run_record import Rows, RunRecord
from netem.core.clock import NS_PER_S
from netem.core.packet_rows import Fate
from netem.core.row_operations import row_norms
from netem.guarantee.loss_guarantee import LossesInWindow
from noack.protocol.record_tables import CONTROLLER_DELIVERY, CONTROLLER_STEP, PLANT_STEP
from noack.protocol.wire_format import Flow
from noack.scenario.outputs import LoopOutput
from noack.scenario.scenario import Scenario

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Flags = NDArray[np.bool_]
Envelope = tuple[str, Quantity, Reals, Reals, BoundKind]
"""A bound: label, bounded quantity, times in s (k,), values (k,), source."""

_FAR = 20.0
"""A bound this many times above everything else in a picture does not set its scale."""
BOUNDED = ("outputs", "errors", "state-norm", "inter-event")
"""The figures that show certified bounds."""
_STATES_NARROWEST_IN, _LOSSES_NARROWEST_IN, _LOSSES_WIDEST_IN = 1.7, 2.2, 5.0
"""Widths of a panel of these figures, in inches."""
_MOST_STATES = 16
_MOST_OUTPUTS, _LEAST_SHOWN, _RARE = 6, 0.01, 0.01
"""Outputs that are drawn; the least distance, as a share of the allowed error; without one, the share of
distances that may be below the axis."""
_LONGEST_TITLE = 40  # characters
_DECADES = 6
"""Maximum decades of an axis of norms."""
_FAR_RATIO, _FAR_OPACITY = 20.0, 0.45
"""A bound that is mostly over this ratio times the curve is drawn with this opacity."""
_MOST_NUMBERED_BARS = 12
_NEAR_LIMIT, _NEAR_LIMIT_RATIO = 50, 10
"""A limit of losses is drawn up to this number, or to this multiple of the largest number that occurred."""


def run_figures(
    record: RunRecord, certified: Sequence[Envelope] = (), *, timed: bool | None = None
) -> dict[str, Callable[[], PageFigure]]:
    """Return functions that describe the figures of a loop, by name.

    Args:
        record: the loop's record, of any length, including 0.
        certified: bounds, drawn with the quantities that they bound.
        timed: whether to show lateness, which does not exist in virtual time.
    """

    @cache
    def aligned() -> _Thinned:
        with np.errstate(all="ignore"):  # a diverged run has figures, too
            return _thinned(record)

    def bounds(quantity: Quantity) -> list[Curve]:
        return bound_curves(envelope for envelope in certified if envelope[1] == quantity)

    figures: dict[str, Callable[[], PageFigure]] = {}
    if outputs := _stated_outputs(record):
        figures["outputs"] = lambda: _outputs(
            record, {output.name: bounds(output.distance) for output in outputs}
        )
    figures |= {
        "states": lambda: _states(record, aligned()),
        "errors": lambda: _errors(record.scenario, aligned().run, bounds("e_c")),
        "state-norm": lambda: _state_norm(record, bounds("x")),
        "input": lambda: _input(record),
        "inter-event": lambda: inter_event_figure(record, bounds("inter_event")),
        "losses": lambda: _losses(record),
    }
    if record.kind == "live" if timed is None else timed:
        figures |= {
            "lateness": lambda: lateness_figure(record),
            "latency": lambda: latency_figure(record),
        }
    return figures


def run_curves(record: RunRecord) -> list[Curve]:
    """Return the curves of a loop: states, errors, ‖x‖, inputs, transmissions, certified bounds."""
    with np.errstate(all="ignore"):  # a diverged run has curves, too
        samples = _thinned(record)
    events = record.events()
    delivered = np.isin(events["event"], record.columns(CONTROLLER_DELIVERY, "sequence")["sequence"])
    return [
        *_states_of(record, samples),
        *(curve for output in _stated_outputs(record) for curve in _output_curves(record, output)),
        *_errors_of(samples.run),
        _norm_of(record),
        *input_curves(record.loop.input_names, *_decimated(record, CONTROLLER_STEP, "u")),
        *transmission_curves(_seconds(events["t_ns"]), delivered),
        *bound_curves(envelopes(record)),
    ]


def envelopes(record: RunRecord) -> Sequence[Envelope]:
    """Return the certified bounds of a loop, to be drawn with the quantities that they bound."""
    try:
        return claims_of(record).envelopes()
    except Exception:  # the figures are useful without them
        return []


class _Thinned(NamedTuple):
    """The samples of a run that its figures need: all of a short run."""

    run: AlignedRun
    true_x: Reals | None


def _thinned(record: RunRecord) -> _Thinned:
    """Align a run; of each part, keep the extremes of all curves at the resolution of a figure."""
    parts = []
    for part in aligned_parts(record):
        run, true_x = _from_first_update(part.aligned, record), part.true_x
        curves = [run.x, run.x_s, run.x_c, run.e_s_norm, run.threshold, run.e_c_norm]
        curves += [] if true_x is None else [true_x]
        keep = decimate_all(_seconds(run.t_ns), np.column_stack(curves), record.slice_columns)
        thin = AlignedRun._make(values[keep] for values in run)
        parts.append(_Thinned(thin, None if true_x is None else true_x[keep]))
    whole = AlignedRun._make(map(np.concatenate, zip(*(part.run for part in parts), strict=True)))
    true_states = [part.true_x for part in parts if part.true_x is not None]
    return _Thinned(whole, np.concatenate(true_states) if true_states else None)


def _from_first_update(run: AlignedRun, record: RunRecord) -> AlignedRun:
    """Return the samples without the controller's state and error before its first update."""
    known = run.since_delivery(record.scenario)
    return run._replace(
        x_c=np.where(known[:, None], run.x_c, np.nan),
        e_c_norm=np.where(known, run.e_c_norm, np.nan),
    )


@np.errstate(all="ignore")  # a run may diverge
def _decimated(
    record: RunRecord, table: str, column: str, curves: Callable[[Rows], Reals] | None = None
) -> tuple[Reals, Reals]:
    """Return times in s (k,) and a vector column, or curves of it, (k, …), reduced like the samples."""
    taken = (lambda rows: np.asarray(rows[column])) if curves is None else curves
    t_s, values = [np.zeros(0)], [taken(np.zeros(0, record.tables[table]))]
    for rows in record.batches(table, ("t_ns", column)):
        part_s, part = _seconds(rows["t_ns"]), taken(rows)
        keep = decimate_all(part_s, part.reshape(len(part), -1), record.slice_columns)
        t_s.append(part_s[keep])
        values.append(part[keep])
    return np.concatenate(t_s), np.concatenate(values)


# States, and times of transmissions and deliveries


class Transmissions(NamedTuple):
    """The transmissions of a loop, and which of them arrived."""

    sent_s: Reals
    """(e,) times t_i of all transmissions."""
    lost: Flags
    """(e,) whether the network lost the transmission."""
    received_s: Reals
    """(d,) times t_i* of the transmissions that the controller received."""
    forced: Flags
    """(d,) whether the guarantee forced the delivery."""


def draw_states(
    figure: "Figure", heading: str, t_s: Reals, states: Sequence[Curve], transmissions: Transmissions
) -> list[Panels]:
    """Draw states, and broadcasting and receiving intervals: the paper's Fig. 2 and 3.

    Args:
        figure: an empty one.
        heading: its title; the number of states is added if only the first 16 are drawn.
        t_s: the times of the run.
        states: the curves of the states.
        transmissions: what was sent and received.
    """
    by_state = [(name, [*curves]) for name, curves in groupby(states, lambda curve: curve.panel)]
    n, count = len(by_state), min(len(by_state), _MOST_STATES)
    wide = columns(figure, _state_columns(count), _STATES_NARROWEST_IN)
    panels = []
    for i, (name, curves) in enumerate(by_state[:count]):
        axes = figure.add_axes((0, 0, 1, 1))
        for curve in curves:  # those in front are thinner, so that equal curves stay visible
            style: dict[str, str] = {"label": ""} if i else {}
            draw_curve(axes, curve, zorder=2.5 - 0.1 * curve.style.width, **style)
        unit = f" [{label_text(curves[0].unit)}]" if curves[0].unit else ""
        axes.set_ylabel(f"{label_text(name)}{unit}")
        set_times(axes, t_s, labelled=i + wide >= count)
        panels.append(axes)
    panels[0].set_title(heading + (f" ({count} of {n} states)" if count < n else ""))
    height_in = 1.45 if count <= 2 * wide else 1.15
    rows = [Panels(panels[i : i + wide], height_in, wide) for i in range(0, count, wide)]
    return [*rows, *(Panels([axes], 1.2) for axes in _draw_intervals(figure, t_s, transmissions))]


def _state_columns(count: int) -> int:
    """Return the number of panels side by side, for the curves of ``count`` states."""
    if count <= 3:
        return count
    if count == 4:
        return 2
    return 3 if count <= 12 else 4


def _draw_intervals(figure: "Figure", t_s: Reals, transmissions: Transmissions) -> "list[Axes]":
    """Draw the times between transmissions and between deliveries; a lost packet is a cross."""
    sent, received = figure.add_axes((0, 0, 1, 1)), figure.add_axes((0, 0, 1, 1))
    sent_s, lost = transmissions.sent_s, transmissions.lost
    received_s, forced = transmissions.received_s, transmissions.forced
    since_sent, since_received = (np.diff(times, prepend=np.nan) for times in (sent_s, received_s))
    lost_s = sent_s[lost]

    draw_marks(sent, sent_s[~lost], since_sent[~lost], SENSOR, label="sent", stems=SENSOR)
    draw_marks(sent, lost_s, since_sent[lost], LOST, label="sent, lost", stems=SENSOR,
               marker="x", markersize=6.5, markeredgewidth=1.8)  # fmt: skip
    draw_marks(received, received_s[~forced], since_received[~forced], CONTROLLER,
               label="received", stems=CONTROLLER)  # fmt: skip
    draw_marks(received, received_s[forced], since_received[forced], FORCED,
               label="received, forced", stems=CONTROLLER, marker="D", markersize=6.0)  # fmt: skip
    draw_marks(received, lost_s, np.zeros(len(lost_s)), LOST, label="lost", marker="x", zorder=3)

    highest = max(np.nanmax(np.append(finite(gaps), 0.0)) for gaps in (since_sent, since_received))
    panels = ((sent, "Broadcasting intervals", sent_s), (received, "Receiving intervals", received_s))
    for axes, title, times in panels:
        axes.set(title=title, ylabel="interval [s]", ylim=(0.0, 1.05 * highest or None))
        mark_empty(axes, "one packet" if len(times) else "no data")
        set_times(axes, t_s, labelled=axes is received)
    return [sent, received]


def _states(record: RunRecord, aligned: _Thinned) -> PageFigure:
    outcomes, run, events = packet_outcomes(record), aligned.run, record.events()
    deliveries = record.columns(CONTROLLER_DELIVERY, "t_ns", "sequence")
    transmissions = Transmissions(
        _seconds(events["t_ns"]),
        np.isin(events["event"], outcomes.sequence[outcomes.lost]),
        _seconds(deliveries["t_ns"]),
        np.isin(deliveries["sequence"], outcomes.sequence[outcomes.fate == Fate.FORCED]),
    )
    scenario, names = record.scenario, record.loop.state_names
    known, states = "x" if scenario.coverage.knows_state else "x̂", _states_of(record, aligned)
    head = "MB-ET" if scenario.mode == "model" else "ZOH-ET"
    heading = ": ".join(filter(None, (head, label_text(scenario.name, _LONGEST_TITLE))))
    return PageFigure(
        name="states",
        draw_panels=lambda figure: draw_states(figure, heading, _seconds(run.t_ns), states, transmissions),
        caption="States, and the times between transmissions and between deliveries: each stem is the time "
        "since the one before, so the first packet has none. "
        + scenario.protocol.states_caption.format(known=known)
        + _estimate_text(scenario)
        + "Cross: a lost packet. Diamond: a delivery that was forced by the guarantee.",
        description=f"Above, the states {', '.join(names)} over time, each as x, x_s and x_c. "
        f"Below, stems for {len(events)} transmissions, of which {int(transmissions.lost.sum())} were "
        f"lost, and for {len(deliveries)} deliveries, of which {int(transmissions.forced.sum())} were "
        "forced.",
    )


def _states_of(record: RunRecord, samples: _Thinned) -> list[Curve]:
    run, true_x = samples
    x, x_hat = (run.x, None) if true_x is None else (true_x, run.x)
    reference = reference_in_run(record)
    x_r = None if reference is None else reference.states(run.t_ns)
    units = record.scenario.model.state_units
    names, t_s = record.loop.state_names, _seconds(run.t_ns)
    return state_curves(names, t_s, x, run.x_s, run.x_c, x_hat, x_r, units)


def _errors_of(run: AlignedRun) -> list[Curve]:
    return error_curves(_seconds(run.t_ns), run.e_s_norm, run.e_c_norm, run.threshold)


def _estimate_text(scenario: Scenario) -> str:
    """Explain x̂, if the sensor does not measure x exactly."""
    if scenario.coverage.knows_state:
        return ""
    if scenario.observer is None:
        return "x̂ is the measurement, x with noise. "
    outputs = scenario.message_sizes.outputs
    return f"x̂ is the estimate of the observer, from {outputs} {'output' if outputs == 1 else 'outputs'}. "


# Outputs with their bounds and allowed errors


def _stated_outputs(record: RunRecord) -> Sequence[LoopOutput]:
    """Return the outputs that the scenario states."""
    return record.scenario.loop_outputs() if record.scenario.outputs else ()


def _output_curves(record: RunRecord, output: LoopOutput) -> list[Curve]:
    """Return the distance of an output from what it follows, over the steps of the plant."""
    parts = [*output_distances(record, output)] or [(np.zeros(0), np.zeros(0))]
    kept = [decimate_all(t_s, values[:, None], record.slice_columns) for t_s, values in parts]
    t_s, distance = (
        np.concatenate([part[i][rows] for part, rows in zip(parts, kept, strict=True)]) for i in (0, 1)
    )
    return output_curves(output, t_s, distance)


def _lowest(bound: Curve) -> float:
    """Return the smallest value of a bound; 0 if it has none."""
    known = bound.values[np.isfinite(bound.values)]
    return float(known.min()) if len(known) else 0.0


def _outputs(record: RunRecord, bounds: Mapping[str, list[Curve]]) -> PageFigure:
    outputs = _stated_outputs(record)[:_MOST_OUTPUTS]
    target = record.scenario.controller.target or "0, as its set-point is not known"
    drawn = {output: _output_curves(record, output) for output in outputs}
    highest = {
        output: max((float(curve.values.max(initial=0.0)) for curve in curves), default=0.0)
        for output, curves in drawn.items()
    }
    near = {
        output: [bound for bound in bounds[output.name] if _lowest(bound) <= _FAR * highest[output]]
        for output in outputs
    }

    def draw(figure: "Figure") -> list[Panels]:
        panels = []
        for i, (output, curves) in enumerate(drawn.items()):
            axes = figure.add_axes((0, 0, 1, 1))
            title = f"{label_text(output.name)}: distance from its {target}"
            draw_norms(axes, title, curves, near[output])
            for bound in bounds[output.name]:
                if all(bound is not each for each in near[output]):
                    least = label_text(output.quantity(f"{_lowest(bound):.3g}"))
                    # An entry of the legend, without a curve.
                    draw_curve(
                        axes,
                        replace(bound, t_s=np.zeros(0), values=np.zeros(0)),
                        label=f"{bound.name}: above {least}, not drawn",
                        alpha=_FAR_OPACITY,
                    )
            low, high = axes.get_ylim()
            if highest[output] > 0:
                high = min(high, _FAR * highest[output])
            values = curves[0].values
            if output.allowed is not None:  # what is far within is of no interest, unless all is
                low = _LEAST_SHOWN * min(output.allowed, values.max(initial=0.0))
            elif len(values):  # nor how near the samples are to the moment at which it is 0
                low = max(low, np.quantile(values, _RARE) / 2)
            if 0 < low < high:
                axes.set_ylim(low, high)
            unit = f" [{label_text(output.unit)}]" if output.unit else ""
            axes.set_ylabel(f"distance{unit}")
            set_times(axes, curves[0].t_s, labelled=i == len(drawn) - 1)
            panels.append(Panels([axes], 2.3))
        return panels

    asked = [output.name for output in outputs if output.allowed is not None]
    allowed = f" Horizontal: the allowed error of {' and '.join(asked)}." if asked else ""
    return PageFigure(
        name="outputs",
        draw_panels=draw,
        caption=f"What the scenario asks of the loop: how far each output is from its {target}.{allowed}"
        + _dashed([bound for each in near.values() for bound in each]),
        description="Distances over time on a logarithmic axis: "
        + ", ".join(
            f"{output.name} up to {output.quantity(largest_text(curves[0].values))}"
            for output, curves in drawn.items()
        )
        + ".",
    )


# Norms with their bounds, and inputs


def draw_norms(axes: "Axes", title: str, curves: Sequence[Curve], bounds: Sequence[Curve] = ()) -> None:
    """Draw norms, and bounds of them; the axis is limited: resets fall to rounding errors."""
    axes.set(title=title, ylabel="norm", yscale="log")
    for curve in curves:
        draw_curve(axes, curve)
    for bound in bounds:
        # With gaps where it is 0: they show the curve behind.
        shown = replace(bound, values=finite(bound.values, positive=True))
        draw_curve(axes, shown, label=bound.name, alpha=_FAR_OPACITY if _is_far(shown, curves) else 1.0)
    limit_decades(axes, np.concatenate([curve.values for curve in curves]), _DECADES)
    set_times(axes, curves[0].t_s)


@np.errstate(all="ignore")
def _is_far(bound: Curve, curves: Sequence[Curve]) -> bool:
    """Whether a bound is many times larger than the curves, most of the time."""
    if not len(bound.t_s) or not all(len(curve.t_s) for curve in curves):
        return False
    at_bound = [np.interp(bound.t_s, curve.t_s, curve.values) for curve in curves]
    ratios = bound.values / np.fmax.reduce(at_bound)
    finite_ratios = ratios[np.isfinite(ratios)]
    return len(finite_ratios) > 0 and bool(np.median(finite_ratios) > _FAR_RATIO)


def _errors(scenario: Scenario, run: AlignedRun, bounds: list[Curve]) -> PageFigure:
    relative = " Both are relative to x̂, the sensor's estimate of x."
    return one_panel(
        "errors",
        2.7,
        lambda axes: draw_norms(axes, "Error norms", _errors_of(run), bounds),
        caption=scenario.protocol.error_caption
        + ("" if scenario.coverage.knows_state else relative)
        + _dashed(bounds),
        description="Error norms over time on a logarithmic axis: "
        f"‖e_s‖ up to {largest_text(run.e_s_norm)}, ‖e_c‖ up to {largest_text(run.e_c_norm)}.",
    )


def _norm_of(record: RunRecord) -> Curve:
    """Return ‖x‖ over the steps of the plant; with a reference or loads the distance that is bounded."""
    reference, rest = reference_in_run(record), record.loop.rest

    def distances(rows: Rows) -> Reals:
        if reference is not None:
            return row_norms(rows["x"] - reference.states(rows["t_ns"]))
        return row_norms(rows["x"] - rest if rest.any() else rows["x"])

    name = "‖x‖" if reference is None and not rest.any() else "‖x − x_r‖"
    return norm_curve(*_decimated(record, PLANT_STEP, "x", distances), name)


def _state_norm(record: RunRecord, bounds: list[Curve]) -> PageFigure:
    curve = _norm_of(record)
    ends = f", from {curve.values[0]:.3g} to {curve.values[-1]:.3g}" if len(curve.t_s) else ""
    name = "Norm of the plant's state"
    if reference_in_run(record) is not None:
        name += " from its reference"
    elif record.loop.rest.any():
        name += " from its rest under the load"
    return one_panel(
        "state-norm",
        2.1,
        lambda axes: draw_norms(axes, "Norm of the state", [curve], bounds),
        caption=f"{name}." + _dashed(bounds),
        description=f"Norm of the state over time on a logarithmic axis{ends}.",
    )


def _input(record: RunRecord) -> PageFigure:
    """Return the figure of the inputs, each of which is held until the next."""
    names, table = record.loop.input_names, CONTROLLER_STEP
    title, caption = "Control input $u = K x_c$", "Control input u = K x_c, held between ticks."
    if record.scenario.controller.update_timeout_s is not None:
        title, caption = "Control input", "Input that the controller sends, held between ticks."
    if record.scenario.network.actuation is not None:
        table, title = PLANT_STEP, "Applied input"
        caption = "Input that the plant applied, also while actuations were missing."
    t_s, u = _decimated(record, table, "u")

    def draw(axes: "Axes") -> None:
        for curve in input_curves(names, t_s, u):
            draw_curve(axes, curve, label=label_text(curve.name))
        axes.set(title=title, ylabel="input")
        set_times(axes, t_s)

    return one_panel(
        "input",
        1.7,
        draw,
        caption=f"{caption} Equal inputs are drawn one inside the other.",
        description=f"Control inputs {', '.join(names)} over time.",
    )


def _dashed(curves: Sequence[Curve]) -> str:
    if not curves:
        return ""
    return f" Dashed: claimed bounds; a pale one is mostly over {_FAR_RATIO:g} times the curves."


def _seconds(t_ns: NDArray[np.int64]) -> Reals:
    return np.asarray(t_ns / NS_PER_S, dtype=np.float64)


def _losses(record: RunRecord) -> PageFigure:
    """Return the figure of the losses that occurred, beside what the guarantee allows."""
    outcomes, network = packet_outcomes(record), record.scenario.network
    bursts, longest = outcomes.loss_bursts(), network.longest_burst
    panels: list[tuple[str, str, str, NDArray[np.int64], int | None]] = []
    panels.append(("Consecutive losses", "consecutive losses", "bursts", bursts, longest))
    for rule in network.guarantee.rules[:3]:
        if isinstance(rule, LossesInWindow):
            title, label = f"Losses in {rule.window} updates", f"losses in {rule.window} consecutive updates"
            panels.append((title, label, "positions", outcomes.losses_in(rule.window), rule.limit))
    actuation_text = ""
    if (actuation := network.actuation) is not None:
        lost, label = packet_outcomes(record, Flow.ACTUATION).loss_bursts(), "consecutive lost actuations"
        panels.append(("Of actuations", label, "bursts", lost, actuation.link.longest_burst))
        actuation_text = " Last panel: the same of actuations."

    def draw(figure: "Figure") -> list[Panels]:
        axes = [figure.add_axes((0, 0, 1, 1)) for _ in panels]
        for one, panel in zip(axes, panels, strict=True):
            draw_losses(one, *panel)
        wide = columns(figure, len(panels), _LOSSES_NARROWEST_IN)
        return [
            Panels(axes[i : i + wide], 1.9, wide, widest_in=_LOSSES_WIDEST_IN)
            for i in range(0, len(axes), wide)
        ]

    limit_name = "the guarantee" if network.enforce_mansd else "the assumption (not enforced)"
    return PageFigure(
        name="losses",
        draw_panels=draw,
        caption="Effective losses of updates: dropped, corrupted, or delivered out of order. "
        f"Dashed: the largest number that {limit_name} allows: {network.guarantee.meaning}.{actuation_text}",
        description=f"{len(bursts)} bursts of losses, the longest of {int(bursts.max(initial=0))}; at most "
        f"{longest} consecutive losses are allowed.",
    )


def draw_losses(
    axes: "Axes", title: str, label: str, counted: str, values: NDArray[np.int64], limit: int | None
) -> None:
    """Draw a histogram of whole numbers (k,), and the largest number that is allowed.

    A limit that is far beyond all numbers is in the label only: beside it no bar could be seen.
    """
    counts = Counter(values.tolist())
    low, high = min([1, *counts]), max([1, *counts])
    if limit is not None and limit > max(_NEAR_LIMIT, _NEAR_LIMIT_RATIO * high):
        label, limit = f"{label} (allowed: {limit:,})", None
    high = max(high, limit or 1)
    heights = np.array([counts[number] for number in range(low, high + 1)], np.float64)
    draw_bars(axes, np.arange(low, high + 2) - 0.5, heights, LOST, share=0.8)
    mark_empty(axes, "no loss")
    if 0 < len(counts) <= _MOST_NUMBERED_BARS:
        axes.margins(y=0.15)
        for number, count in counts.items():
            axes.text(number, count, f"{count:,g}", ha="center", va="bottom", size="small")
    if limit is not None:
        axes.axvline(limit + 0.5, color=rgb(palette.CERTIFIED), dashes=DASHED, linewidth=1.6)
    axes.set(title=title, xlabel=label, ylabel=counted, xlim=(low - 0.6, high + 0.9))
    axes.grid(visible=False, axis="x")
    whole_numbers(axes, "x")
    whole_numbers(axes, "y")
