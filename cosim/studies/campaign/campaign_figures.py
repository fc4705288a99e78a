"""The figures of a campaign; intervals are 95 % confidence intervals of the means."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cosim.output.curves import DASHES, Dash
from cosim.output.figures.figure_description import (
    MARKERS,
    Axis,
    Band,
    ColourScale,
    FigureDescription,
    Heat,
    Item,
    Line,
    Marks,
    Panel,
    PanelRow,
    label_text,
    one_panel,
    series_colour,
)
from cosim.output.figures.palette import Colour
from cosim.studies.campaign import campaign_file
from cosim.studies.campaign.campaign_summary import CampaignSummary, GridPointResult, runs_at
from cosim.studies.campaign.chunk_store import Store
from cosim.studies.campaign.metrics import METRICS, Estimate, Metric, to_shown_unit
from noack.core.linear_systems import Matrix, Vector

_HEIGHT_IN = 3.4
_MAP_HEIGHT_IN, _MAPS_IN_A_ROW, _NARROWEST_MAP_IN = 2.2, 3, 2.2
_QUANTILES = 400
"""Points of a distribution."""
_FAR = 10.0
"""A metric with values at least this factor apart gets a logarithmic axis."""
_LONGEST_LABEL = 28


def figures(summary: CampaignSummary, store: Store) -> Iterator[FigureDescription]:
    """Describe the figures that the campaign asks for."""
    for i, spec in enumerate(summary.campaign.figures):
        selected = set(summary.campaign.selected(spec.where))
        results = [result for result in summary.results if result.point.indices in selected]
        match spec:
            case campaign_file.Pareto():
                figure, caption = _pareto(summary, results, spec)
            case campaign_file.MetricCurve():
                figure, caption = _curve(summary, results, spec)
            case campaign_file.HeatMap():
                figure, caption = _heat_map(summary, results, spec)
            case campaign_file.Distribution():
                figure, caption = _distribution(summary, results, spec, store)
        conditions = [f"{axis} = {campaign_file.label_of(v)}" for axis, v in spec.where.items()]
        name = f"{spec.kind.replace('_', '-')}-{i + 1}"
        yield replace(figure, name=name, caption=f"{', '.join([caption, *conditions])}.")


def pareto_figure(
    series: Mapping[str, tuple[Sequence[Estimate], Sequence[Estimate]]], x: Metric, y: Metric
) -> FigureDescription:
    """Describe means of y against means of x, with intervals; a line joins undominated points."""
    items: list[Item] = []
    for i, (name, pair) in enumerate(series.items()):
        (xs, dx), (ys, dy) = map(_means, pair)
        finite = np.isfinite(xs) & np.isfinite(ys)
        front = np.flatnonzero(finite)[undominated(xs[finite], ys[finite])]
        colour, marker, dash = _style(i)
        items += [
            Marks(x=xs, y=ys, x_error=dx, y_error=dy, colour=colour, reduced=False, marker=marker,
                  label=_name(name)),
            Line(x=xs[front], y=ys[front], colour=colour, steps="post", dash=dash),
        ]  # fmt: skip
    means_x, means_y = ([e.mean for pair in series.values() for e in pair[k]] for k in (0, 1))
    return one_panel("pareto", Panel(items=items, x=_axis(x, means_x), y=_axis(y, means_y)), _HEIGHT_IN)


def undominated(x: Vector, y: Vector) -> NDArray[np.intp]:
    """Return the indices, by ascending x, of the points that no other point dominates, (k,)."""
    front: list[int] = []
    for i in np.lexsort((y, x)):
        if not front or y[i] < y[front[-1]]:
            front.append(int(i))
    return np.array(front, dtype=np.intp)


def curve_figure(
    x: Vector | None,
    labels: Sequence[str],
    series: Mapping[str, Sequence[Estimate | None]],
    axis: str,
    metric: Metric,
) -> FigureDescription:
    """Describe the means of a metric over an axis, with their intervals.

    The axis has k values ``x`` (None if they are not numbers) with k labels, and is logarithmic if
    they grow by factors; each series has k estimates, or None where there is no estimate.
    """
    xs = np.arange(len(labels), dtype=np.float64) if x is None else x
    order = np.argsort(xs)
    items: list[Item] = []
    for i, (name, estimates) in enumerate(series.items()):
        mean, half = (values[order] for values in _means(estimates))
        colour, marker, dash = _style(i)
        items += [
            Line(x=xs[order], y=mean, label=_name(name), colour=colour, size=4, marker=marker, dash=dash),
            Band(x=xs[order], low=mean - half, high=mean + half, colour=colour),
        ]
    ticks = dict(zip(xs.tolist(), map(label_text, labels), strict=True)) if x is None else None
    means = [e.mean for estimates in series.values() for e in estimates if e]
    x_axis = Axis(label=_name(axis), ticks=ticks, logarithmic=x is not None and _is_geometric(x))
    panel = Panel(items=items, x=x_axis, y=_axis(metric, means))
    return one_panel("curve", panel, _HEIGHT_IN)


def heat_map_figure(
    maps: Mapping[str, Matrix],
    x: tuple[str, Sequence[str]],
    y: tuple[str, Sequence[str]],
    metric: Metric,
) -> FigureDescription:
    """Describe maps of a metric with a common scale.

    Each map has the shape (values of y, values of x); NaN is a missing value. x and y are title and
    labels of the axes.
    """
    finite = np.stack(list(maps.values()))
    finite = finite[np.isfinite(finite)]
    scale = None
    if len(finite):
        scale = ColourScale(
            low=finite.min(),
            high=finite.max(),
            label=METRICS[metric].label,
            logarithmic=METRICS[metric].logarithmic and _is_wide(finite),
        )
    axes = [
        Axis(label=_name(name), ticks=dict(enumerate(map(label_text, labels))), grid=False)
        for name, labels in (x, y)
    ]
    panels = [
        Panel(
            title=_name(title),
            x=axes[0],
            y=axes[1],
            items=[Heat(values=values, x_ends=(-0.5, len(x[1]) - 0.5), numbers=True)] if scale else [],
        )
        for title, values in maps.items()
    ]
    row = PanelRow(
        panels=panels,
        height_in=_MAP_HEIGHT_IN,
        columns=_MAPS_IN_A_ROW,
        common="xy",
        narrowest_in=_NARROWEST_MAP_IN,
    )
    return FigureDescription(name="heat-map", rows=[row], scale=scale)


def distribution_figure(series: Mapping[str, Vector], metric: Metric) -> FigureDescription:
    """Describe the cumulative distribution of a metric; infinite values keep a curve below 1."""
    share = np.linspace(0.0, 1.0, _QUANTILES + 1)
    items = []
    for i, (name, values) in enumerate(series.items()):
        xs = np.quantile(values, share, method="inverted_cdf")
        is_known = np.isfinite(xs)
        colour, _, dash = _style(i)
        items.append(
            Line(x=xs[is_known], y=share[is_known], label=_name(name), colour=colour, dash=dash, steps="post")
        )
    x = _axis(metric, np.concatenate(list(series.values())))
    panel = Panel(items=items, x=x, y=Axis(label="share of runs", ends=(0, 1.02)))
    return one_panel("distribution", panel, _HEIGHT_IN)


def _pareto(
    summary: CampaignSummary, results: Sequence[GridPointResult], spec: campaign_file.Pareto
) -> tuple[FigureDescription, str]:
    series: dict[str, tuple[list[Estimate], list[Estimate]]] = {}
    for result in results:
        if spec.x in result.estimates and spec.y in result.estimates:
            xs, ys = series.setdefault(result.point.labels[spec.series], ([], []))
            xs.append(to_shown_unit(spec.x, result.estimates[spec.x]))
            ys.append(to_shown_unit(spec.y, result.estimates[spec.y]))
    series_name = summary.campaign.by_name[spec.series].name_in_figures
    return pareto_figure(series, spec.x, spec.y), (
        f"{_title(spec.y)} against {METRICS[spec.x].title}, means with 95 % confidence "
        f"intervals; for each {series_name} the points that none of its own dominates are joined"
        + _left_out(estimate for pair in series.values() for estimates in pair for estimate in estimates)
    )


def _curve(
    summary: CampaignSummary, results: Sequence[GridPointResult], spec: campaign_file.MetricCurve
) -> tuple[FigureDescription, str]:
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
    return curve_figure(numbers, labels, series, axis.heading, spec.metric), (
        f"{_title(spec.metric)} over {axis.name_in_figures}: means and 95 % confidence intervals"
        + _left_out(estimate for curve in series.values() for estimate in curve if estimate)
    )


def _heat_map(
    summary: CampaignSummary, results: Sequence[GridPointResult], spec: campaign_file.HeatMap
) -> tuple[FigureDescription, str]:
    x, y = (summary.campaign.by_name[name] for name in (spec.x, spec.y))
    maps = {}
    spanned = (spec.x, spec.y, *spec.where)
    for label, group in _series(summary, results, spanned).items():
        maps[label] = np.full((len(y.labels), len(x.labels)), np.nan)
        for result in group:
            if spec.metric in result.estimates:
                row, column = (axis.labels.index(result.point.labels[axis.name]) for axis in (y, x))
                maps[label][row, column] = to_shown_unit(spec.metric, result.estimates[spec.metric]).mean
    figure = heat_map_figure(maps, (x.heading, x.labels), (y.heading, y.labels), spec.metric)
    return figure, f"{_title(spec.metric)} over {x.name_in_figures} and {y.name_in_figures}: means"


def _distribution(
    summary: CampaignSummary,
    results: Sequence[GridPointResult],
    spec: campaign_file.Distribution,
    store: Store,
) -> tuple[FigureDescription, str]:
    series = {
        label: METRICS[spec.metric].scale * runs_at(result.point, store)[0][spec.metric]
        for label, group in _series(summary, results, tuple(spec.where)).items()
        for result in group
        if spec.metric in result.estimates
    }
    return distribution_figure(series, spec.metric), (
        f"{_title(spec.metric)}: cumulative distribution over the runs"
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


def _axis(metric: Metric, values: Sequence[float] | Vector) -> Axis:
    """Return a metric's axis: logarithmic if the finite values are positive and far apart."""
    array = np.asarray(values)
    is_log = METRICS[metric].logarithmic and _is_wide(array[np.isfinite(array)])
    return Axis(label=METRICS[metric].label, logarithmic=is_log)


def _is_geometric(values: Vector) -> bool:
    """Whether values are far apart, and their middle is nearer to the geometric mean of the ends."""
    middle, ends = float(np.median(values)), (values.min(), values.max())
    return _is_wide(values) and middle - math.sqrt(ends[0] * ends[1]) < sum(ends) / 2 - middle


def _is_wide(values: Vector) -> bool:
    return bool(len(values) and values.min() > 0 and values.max() >= _FAR * values.min())
