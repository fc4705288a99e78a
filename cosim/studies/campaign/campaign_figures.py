"""The figures of a campaign; intervals are 95 % confidence intervals of the means."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cosim.output.curves import DASHES, Dash
from cosim.output.figures.axes_parts import (
    MARKERS,
    draw_band,
    draw_line,
    draw_points,
    label_text,
    name_ticks,
    series_colour,
)
from cosim.output.figures.page_figure import PageFigure, one_panel
from cosim.output.figures.palette import Colour
from cosim.output.figures.panels import (
    BAR_IN,
    Panels,
    add_colour_bar,
    character_in,
    columns,
    labels_in,
    margins,
)
from cosim.studies.campaign import campaign_file
from cosim.studies.campaign.campaign_summary import CampaignSummary, GridPointResult, runs_at
from cosim.studies.campaign.chunk_store import Store
from cosim.studies.campaign.metrics import METRICS, Estimate, Metric, to_shown_unit
from noack.core.linear_systems import Matrix, Vector

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure

_HEIGHT_IN = 3.4
_MAP_HEIGHT_IN, _MAPS_IN_A_ROW, _NARROWEST_MAP_IN = 2.2, 3, 2.2
_QUANTILES = 400
"""Points of a distribution."""
_FAR = 10.0
"""A metric with values at least this factor apart gets a logarithmic axis."""
_LONGEST_LABEL = 28
_NARROWEST_CELL_IN, _DARK_CELL = 0.42, 0.6
"""Narrowest cell of a map in which its number is written, and the share of the largest value below
which this number is white."""


def figures(summary: CampaignSummary, store: Store) -> Iterator[PageFigure]:
    """Yield the figures that the campaign asks for."""
    for i, spec in enumerate(summary.campaign.figures):
        selected = set(summary.campaign.selected(spec.where))
        results = [result for result in summary.results if result.point.indices in selected]
        match spec:
            case campaign_file.Pareto():
                figure = _pareto(summary, results, spec)
            case campaign_file.MetricCurve():
                figure = _curve(summary, results, spec)
            case campaign_file.HeatMap():
                figure = _heat_map(summary, results, spec)
            case campaign_file.Distribution():
                figure = _distribution(summary, results, spec, store)
        conditions = [f"{axis} = {campaign_file.label_of(v)}" for axis, v in spec.where.items()]
        name = f"{spec.kind.replace('_', '-')}-{i + 1}"
        yield replace(figure, name=name, caption=f"{', '.join([figure.caption, *conditions])}.")


def draw_pareto(
    axes: "Axes", series: Mapping[str, tuple[Sequence[Estimate], Sequence[Estimate]]], x: Metric, y: Metric
) -> None:
    """Draw means of y against means of x, with intervals; a line joins undominated points."""
    for letter, metric, k in (("x", x, 0), ("y", y, 1)):
        _set_axis(axes, letter, metric, [e.mean for pair in series.values() for e in pair[k]])
    for i, (name, pair) in enumerate(series.items()):
        (xs, dx), (ys, dy) = map(_means, pair)
        finite = np.isfinite(xs) & np.isfinite(ys)
        front = np.flatnonzero(finite)[undominated(xs[finite], ys[finite])]
        colour, marker, dash = _style(i)
        draw_points(axes, xs, ys, dx, dy, colour, marker=marker, label=_name(name))
        draw_line(axes, xs[front], ys[front], colour, dash, drawstyle="steps-post")


def undominated(x: Vector, y: Vector) -> NDArray[np.intp]:
    """Return the indices, by ascending x, of the points that no other point dominates, (k,)."""
    front: list[int] = []
    for i in np.lexsort((y, x)):
        if not front or y[i] < y[front[-1]]:
            front.append(int(i))
    return np.array(front, dtype=np.intp)


def draw_means(
    axes: "Axes",
    x: Vector | None,
    labels: Sequence[str],
    series: Mapping[str, Sequence[Estimate | None]],
    axis: str,
    metric: Metric,
) -> None:
    """Draw the means of a metric over an axis, with their intervals.

    The axis has k values ``x`` (None if they are not numbers) with k labels, and is logarithmic if
    they grow by factors; each series has k estimates, or None where there is no estimate.
    """
    xs = np.arange(len(labels), dtype=np.float64) if x is None else x
    order = np.argsort(xs)
    axes.set(xlabel=_name(axis), xscale="log" if x is not None and _is_geometric(x) else "linear")
    _set_axis(axes, "y", metric, [e.mean for estimates in series.values() for e in estimates if e])
    for i, (name, estimates) in enumerate(series.items()):
        mean, half = (values[order] for values in _means(estimates))
        colour, marker, dash = _style(i)
        draw_line(axes, xs[order], mean, colour, dash, label=_name(name), marker=marker, markersize=4)
        draw_band(axes, xs[order], mean - half, mean + half, colour)
    if x is None:
        name_ticks(axes, "x", dict(zip(xs.tolist(), map(label_text, labels), strict=True)))


def draw_heat_maps(
    figure: "Figure",
    maps: Mapping[str, Matrix],
    x: tuple[str, Sequence[str]],
    y: tuple[str, Sequence[str]],
    metric: Metric,
) -> list[Panels]:
    """Draw maps of a metric with a common scale.

    Each map has the shape (values of y, values of x); NaN is a missing value. x and y are title and
    labels of the axes.
    """
    finite = np.stack(list(maps.values()))
    finite = finite[np.isfinite(finite)]
    is_log = METRICS[metric].logarithmic and _is_wide(finite)
    count, wide = len(maps), columns(figure, min(_MAPS_IN_A_ROW, len(maps)), _NARROWEST_MAP_IN)
    x_labels, y_labels = [*map(label_text, x[1])], [*map(label_text, y[1])]
    beside_in = max(margins(figure).left, labels_in(y_labels)) + 4 * BAR_IN  # and the colours' bar
    cell_in = (figure.get_figwidth() - beside_in) / wide / len(x_labels)
    turned_in = max(map(len, x_labels)) * character_in()
    turned_in = turned_in / math.sqrt(2) if turned_in > cell_in else 0.0
    panels, mesh = [], None
    for i, (title, values) in enumerate(maps.items()):
        axes = figure.add_axes((0, 0, 1, 1))
        if len(finite):
            mesh = axes.pcolormesh(
                values, norm="log" if is_log else "linear", vmin=finite.min(), vmax=finite.max()
            )
            _write_values(axes, values, mesh, cell_in)
        axes.set(title=_name(title))
        is_lowest, is_first = i + wide >= count, i % wide == 0
        name_ticks(axes, "x", {k + 0.5: label for k, label in enumerate(x_labels)})
        name_ticks(axes, "y", {k + 0.5: label for k, label in enumerate(y_labels)})
        axes.set(xlabel=_name(x[0]) if is_lowest else "", ylabel=_name(y[0]) if is_first else "")
        axes.grid(visible=False)
        axes.tick_params(length=0, labelbottom=is_lowest, labelleft=is_first)
        axes.tick_params(axis="x", rotation=45 if turned_in else 0)
        panels.append(axes)
    rows = [
        Panels(
            panels[i : i + wide], _MAP_HEIGHT_IN, wide, is_tight=True, left_in=labels_in(y_labels),
            below_in=turned_in,
        )
        for i in range(0, count, wide)
    ]  # fmt: skip
    if mesh is not None:
        add_colour_bar(figure, rows, mesh, label=METRICS[metric].label)
    return rows


def _write_values(axes: "Axes", values: Matrix, colours: "ScalarMappable", cell_in: float) -> None:
    """Write the values of a map into its cells, if there is room."""
    if cell_in < _NARROWEST_CELL_IN:
        return
    shares = np.ma.getdata(colours.norm(np.asarray(values)))
    for (row, column), value in np.ndenumerate(values):
        if np.isfinite(value):
            colour = "#ffffff" if shares[row, column] < _DARK_CELL else "#000000"
            axes.text(
                column + 0.5, row + 0.5, f"{value:.3g}", ha="center", va="center", size=7.5, color=colour
            )


def draw_distribution(axes: "Axes", series: Mapping[str, Vector], metric: Metric) -> None:
    """Draw the cumulative distribution of a metric; infinite values keep a curve below 1."""
    share = np.linspace(0.0, 1.0, _QUANTILES + 1)
    _set_axis(axes, "x", metric, np.concatenate(list(series.values())))
    for i, (name, values) in enumerate(series.items()):
        xs = np.quantile(values, share, method="inverted_cdf")
        known = np.isfinite(xs)
        colour, _, dash = _style(i)
        draw_line(axes, xs[known], share[known], colour, dash, label=_name(name), drawstyle="steps-post")
    axes.set(ylabel="share of runs", ylim=(0, 1.02))


def _pareto(
    summary: CampaignSummary, results: Sequence[GridPointResult], spec: campaign_file.Pareto
) -> PageFigure:
    series: dict[str, tuple[list[Estimate], list[Estimate]]] = {}
    for result in results:
        if spec.x in result.estimates and spec.y in result.estimates:
            xs, ys = series.setdefault(result.point.labels[spec.series], ([], []))
            xs.append(to_shown_unit(spec.x, result.estimates[spec.x]))
            ys.append(to_shown_unit(spec.y, result.estimates[spec.y]))
    series_name = summary.campaign.by_name[spec.series].name_in_figures
    return one_panel(
        "pareto",
        _HEIGHT_IN,
        lambda axes: draw_pareto(axes, series, spec.x, spec.y),
        caption=f"{_title(spec.y)} against {METRICS[spec.x].title}, means with 95 % confidence "
        f"intervals; for each {series_name} the points that none of its own dominates are joined"
        + _left_out(estimate for pair in series.values() for estimates in pair for estimate in estimates),
    )


def _curve(
    summary: CampaignSummary, results: Sequence[GridPointResult], spec: campaign_file.MetricCurve
) -> PageFigure:
    axis = summary.campaign.by_name[spec.x]
    curves = {
        name: {
            result.point.labels[axis.name]: to_shown_unit(spec.metric, result.estimates[spec.metric])
            for result in group
            if spec.metric in result.estimates
        }
        for name, group in _series(summary, results, (spec.x, *spec.where)).items()
    }
    measured = [i for i, x in enumerate(axis.labels) if any(curve.get(x) for curve in curves.values())]
    labels = [axis.labels[i] for i in measured]
    series = {name: [curve.get(x) for x in labels] for name, curve in curves.items() if any(curve.values())}
    numbers = None if axis.numbers is None else np.array(axis.numbers)[measured]
    return one_panel(
        "curve",
        _HEIGHT_IN,
        lambda axes: draw_means(axes, numbers, labels, series, axis.heading, spec.metric),
        caption=f"{_title(spec.metric)} over {axis.name_in_figures}: means and 95 % confidence intervals"
        + _left_out(estimate for curve in series.values() for estimate in curve if estimate),
    )


def _heat_map(
    summary: CampaignSummary, results: Sequence[GridPointResult], spec: campaign_file.HeatMap
) -> PageFigure:
    x, y = (summary.campaign.by_name[name] for name in (spec.x, spec.y))
    maps = {}
    spanned = (spec.x, spec.y, *spec.where)
    for label, group in _series(summary, results, spanned).items():
        maps[label] = np.full((len(y.labels), len(x.labels)), np.nan)
        for result in group:
            if spec.metric in result.estimates:
                row, column = (axis.labels.index(result.point.labels[axis.name]) for axis in (y, x))
                maps[label][row, column] = to_shown_unit(spec.metric, result.estimates[spec.metric]).mean
    headings = (x.heading, x.labels), (y.heading, y.labels)
    return PageFigure(
        name="heat-map",
        draw_panels=lambda figure: draw_heat_maps(figure, maps, *headings, spec.metric),
        caption=f"{_title(spec.metric)} over {x.name_in_figures} and {y.name_in_figures}: means",
    )


def _distribution(
    summary: CampaignSummary,
    results: Sequence[GridPointResult],
    spec: campaign_file.Distribution,
    store: Store,
) -> PageFigure:
    series = {
        label: METRICS[spec.metric].scale * runs_at(result.point, store)[0][spec.metric]
        for label, group in _series(summary, results, tuple(spec.where)).items()
        for result in group
        if spec.metric in result.estimates
    }
    return one_panel(
        "distribution",
        _HEIGHT_IN,
        lambda axes: draw_distribution(axes, series, spec.metric),
        caption=f"{_title(spec.metric)}: cumulative distribution over the runs",
    )


def _series(
    summary: CampaignSummary, results: Sequence[GridPointResult], spanned: tuple[str, ...]
) -> dict[str, list[GridPointResult]]:
    """Group grid points by the values of the axes that the figure does not show as coordinates."""
    other_axes = [axis for axis in summary.campaign.axes if axis.name not in spanned]
    groups: dict[str, list[GridPointResult]] = {}
    for result in results:
        label = ", ".join(
            result.point.labels[axis.name]
            if axis.numbers is None
            else f"{axis.name_in_figures} = {result.point.labels[axis.name]}"
            for axis in other_axes
        )
        groups.setdefault(label, []).append(result)
    return groups


def _style(i: int) -> tuple[Colour, str, Dash]:
    """Return colour, marker and dashes of the i-th series."""
    return series_colour(i), MARKERS[i % len(MARKERS)], DASHES[i % len(DASHES)]


def _name(text: str) -> str:
    return label_text(text, _LONGEST_LABEL)


def _means(estimates: Sequence[Estimate | None]) -> tuple[Vector, Vector]:
    """Return means and half-widths, (k,); NaN where there is none: a single run has no interval."""
    mean = np.array([e.mean if e and math.isfinite(e.mean) else np.nan for e in estimates])
    half = np.array([e.halfwidth if e and math.isfinite(e.halfwidth) else np.nan for e in estimates])
    return mean, half


def _left_out(estimates: Iterable[Estimate]) -> str:
    """Return what a caption says of runs whose metric is infinite, which the means leave out."""
    shares = [estimate.finite / estimate.draws for estimate in estimates]
    if min(shares, default=1.0) == 1:
        return ""
    text = "; runs without a finite value are left out"
    if (most := max((1 - share for share in shares if share), default=0.0)) > 0:
        text += f", at one point {100 * most:.3g} % of them"
    return text + ("; where none is left, the point is missing" if min(shares) == 0 else "")


def _title(metric: Metric) -> str:
    title = METRICS[metric].title
    return title[0].upper() + title[1:]


def _set_axis(axes: "Axes", letter: str, metric: Metric, values: Sequence[float] | Vector) -> None:
    """Label a metric's axis; it is logarithmic if the finite values are positive and far apart."""
    array = np.asarray(values)
    is_log = METRICS[metric].logarithmic and _is_wide(array[np.isfinite(array)])
    scale = "log" if is_log else "linear"
    axes.set(**{f"{letter}label": METRICS[metric].label, f"{letter}scale": scale})


def _is_geometric(values: Vector) -> bool:
    """Whether values are far apart, and their middle is nearer to the geometric mean of the ends."""
    middle, ends = float(np.median(values)), (values.min(), values.max())
    return _is_wide(values) and middle - math.sqrt(ends[0] * ends[1]) < sum(ends) / 2 - middle


def _is_wide(values: Vector) -> bool:
    return bool(len(values) and values.min() > 0 and values.max() >= _FAR * values.min())
