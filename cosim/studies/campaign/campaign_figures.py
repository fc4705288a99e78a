"""The figures of a campaign; intervals are 95 % confidence intervals of the means."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cosim.output import palette
from cosim.output.report.axes import finish, layout, legend, logarithmic, plain, single
from cosim.output.report.figure_style import printed, styled
from cosim.studies.campaign import campaign_file
from cosim.studies.campaign.campaign_summary import CampaignSummary, GridPointResult, runs_at
from cosim.studies.campaign.chunk_store import Store
from cosim.studies.campaign.metrics import METRICS, Estimate, Metric
from noack.core.linear_systems import Matrix, Vector

_HEIGHT_IN = 3.4
_MAP_HEIGHT_IN, _MAPS_IN_A_ROW, _NARROWEST_MAP_IN = 2.8, 3, 2.2
_QUANTILES = 400
_NARROWEST_IN = 0.42
"""Narrowest cell of a map in which its number is written, in inches."""
_FAR = 10.0
"""A metric with values further apart than this factor gets a logarithmic axis."""
_LONGEST_LABEL = 28
_MARKERS = "os^Dv<>PXph*"
_DASHES: tuple[Any, ...] = ("-", (0, (6, 1.5)), (0, (2, 1.2)), (0, (6, 1.5, 1.5, 1.5)))


def figures(summary: CampaignSummary, store: Store) -> Iterator[tuple[str, Figure, str]]:
    """Draw the figures that the campaign asks for; return them with name and caption."""
    for i, wanted in enumerate(summary.campaign.figures):
        places = set(summary.campaign.selected(wanted.where))
        found = [one for one in summary.found if one.point.place in places]
        where = "".join(
            f", {axis} = {campaign_file.label_of(v)}" for axis, v in wanted.where.items()
        )
        match wanted:
            case campaign_file.Pareto():
                figure, caption = _pareto(summary, found, wanted)
            case campaign_file.Curve():
                figure, caption = _curve(summary, found, wanted)
            case campaign_file.HeatMap():
                figure, caption = _heat_map(summary, found, wanted)
            case campaign_file.Distribution():
                figure, caption = _distribution(summary, found, wanted, store)
        yield f"{wanted.kind.replace('_', '-')}-{i + 1}", figure, f"{caption}{where}."


@styled
def pareto_figure(
    series: Mapping[str, tuple[Sequence[Estimate], Sequence[Estimate]]], x: Metric, y: Metric
) -> Figure:
    """Draw means of y against means of x, with intervals; a line joins the non-dominated points."""
    figure, axes, styles = _panel(list(series))
    for pair, style in zip(series.values(), styles, strict=True):
        (xs, dx), (ys, dy) = map(_means, pair)
        color, marker = style["color"], style["marker"]
        axes.errorbar(xs, ys, dy, dx, color=color, marker=marker, linestyle="none", elinewidth=1.0)
        finite = np.isfinite(xs) & np.isfinite(ys)
        xs, ys = xs[finite], ys[finite]
        front = undominated(xs, ys)
        axes.plot(xs[front], ys[front], drawstyle="steps-post", **style | {"marker": ""})
    axes.set(xlabel=METRICS[x].label, ylabel=METRICS[y].label)
    _scale(axes, "x", [e.mean for xs, _ in series.values() for e in xs], x)
    _scale(axes, "y", [e.mean for _, ys in series.values() for e in ys], y)
    finish(axes)
    return figure


def undominated(x: Vector, y: Vector) -> Any:
    """Return the indices, by ascending x, of the points that no other point dominates, (k,)."""
    front: list[int] = []
    for i in np.lexsort((y, x)):
        if not front or y[i] < y[front[-1]]:
            front.append(int(i))
    return np.array(front, dtype=np.intp)


@styled
def curve_figure(
    x: Vector | None,
    labels: Sequence[str],
    series: Mapping[str, Sequence[Estimate | None]],
    axis: str,
    metric: Metric,
) -> Figure:
    """Draw the means of a metric over an axis, with their intervals.

    The axis has k values ``x`` (None if they are not numbers) with k labels; each series has k
    estimates, or None where there is no estimate.
    """
    figure, axes, styles = _panel(list(series))
    at = np.arange(len(labels), dtype=np.float64) if x is None else x
    order = np.argsort(at)
    for estimates, style in zip(series.values(), styles, strict=True):
        mean, half = (values[order] for values in _means(estimates))
        axes.plot(at[order], mean, markersize=4, **style)
        low, high = mean - half, mean + half
        axes.fill_between(at[order], low, high, color=style["color"], alpha=0.25, linewidth=0)
    if x is None:
        axes.set_xticks(at, [plain(label) for label in labels])
    axes.set(xlabel=plain(axis, _LONGEST_LABEL), ylabel=METRICS[metric].label)
    _scale(axes, "y", [e.mean for estimates in series.values() for e in estimates if e], metric)
    finish(axes)
    return figure


@styled
def heat_map_figure(
    maps: Mapping[str, Matrix],
    x: tuple[str, Sequence[str]],
    y: tuple[str, Sequence[str]],
    metric: Metric,
) -> Figure:
    """Draw maps of a metric with a common scale.

    Each map has the shape (values of y, values of x); NaN is a missing value. x and y are title and
    labels of the axes.
    """
    space, columns = layout(), min(len(maps), _MAPS_IN_A_ROW)
    columns = min(columns, int(space.width_in / _NARROWEST_MAP_IN))
    rows = -(-len(maps) // columns)
    size_in = (space.width_in, rows * _MAP_HEIGHT_IN * space.scale)
    figure = Figure(figsize=size_in, layout="constrained")
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
    known = np.stack(list(maps.values()))
    known = known[np.isfinite(known)]
    kind = LogNorm if METRICS[metric].logarithmic and _far(known) else Normalize
    norm = kind(known.min(), known.max()) if len(known) else Normalize()
    for i, (title, values) in enumerate(maps.items()):
        axes = panels[i]
        drawn = axes.pcolormesh(np.ma.masked_invalid(values), norm=norm, cmap="viridis")
        if space.width_in / columns >= _NARROWEST_IN * values.shape[1]:
            _numbers(axes, values, drawn)
        axes.set_xticks(np.arange(len(x[1])) + 0.5, [plain(label) for label in x[1]])
        axes.set_yticks(np.arange(len(y[1])) + 0.5, [plain(label) for label in y[1]])
        axes.tick_params(length=0, labelbottom=i + columns >= len(maps))
        axes.grid(visible=False)
        axes.set_title(plain(title, _LONGEST_LABEL))
    for axes in panels[len(maps) :]:
        axes.set_visible(False)
    figure.supxlabel(plain(x[0], _LONGEST_LABEL), size="medium")
    figure.supylabel(plain(y[0], _LONGEST_LABEL), size="medium")
    if len(known):
        bar = figure.colorbar(drawn, ax=panels, label=METRICS[metric].label, pad=0.01)
        bar.ax.grid(visible=False)
    return figure


@styled
def distribution_figure(series: Mapping[str, Vector], metric: Metric) -> Figure:
    """Draw the cumulative distribution of a metric; infinite values keep a curve below 1."""
    figure, axes, styles = _panel(list(series), markers=False)
    share = np.linspace(0.0, 1.0, _QUANTILES + 1)
    for values, style in zip(series.values(), styles, strict=True):
        at = np.quantile(values, share, method="inverted_cdf")
        seen = np.isfinite(at)
        axes.plot(at[seen], share[seen], drawstyle="steps-post", **style)
    axes.set(xlabel=METRICS[metric].label, ylabel="share of runs", ylim=(0, 1.02))
    _scale(axes, "x", np.concatenate(list(series.values())), metric)
    finish(axes)
    return figure


def _pareto(
    summary: CampaignSummary, found: Sequence[GridPointResult], wanted: campaign_file.Pareto
) -> tuple[Figure, str]:
    series: dict[str, tuple[list[Estimate], list[Estimate]]] = {}
    for one in found:
        if wanted.x in one.estimates and wanted.y in one.estimates:
            xs, ys = series.setdefault(one.point.labels[wanted.series], ([], []))
            xs.append(one.estimates[wanted.x])
            ys.append(one.estimates[wanted.y])
    called = summary.campaign.by_name[wanted.series].called
    return pareto_figure(series, wanted.x, wanted.y), (
        f"{_title(wanted.y)} against {METRICS[wanted.x].title}, means with 95 % confidence "
        f"intervals; for each {called} the points that none of its own dominates are joined"
    )


def _curve(
    summary: CampaignSummary, found: Sequence[GridPointResult], wanted: campaign_file.Curve
) -> tuple[Figure, str]:
    axis = summary.campaign.by_name[wanted.x]
    known = {
        name: {one.point.labels[axis.name]: one.estimates.get(wanted.metric) for one in group}
        for name, group in _series(summary, found, (wanted.x, *wanted.where)).items()
    }
    places = [i for i, x in enumerate(axis.labels) if any(one.get(x) for one in known.values())]
    labels = [axis.labels[i] for i in places]
    series = {
        name: [one.get(x) for x in labels] for name, one in known.items() if any(one.values())
    }
    numbers = None if axis.numbers is None else np.array(axis.numbers)[places]
    return curve_figure(numbers, labels, series, axis.called, wanted.metric), (
        f"{_title(wanted.metric)} over {axis.called}: means and 95 % confidence intervals"
    )


def _heat_map(
    summary: CampaignSummary, found: Sequence[GridPointResult], wanted: campaign_file.HeatMap
) -> tuple[Figure, str]:
    x, y = (summary.campaign.by_name[name] for name in (wanted.x, wanted.y))
    maps = {}
    spanned = (wanted.x, wanted.y, *wanted.where)
    for label, group in _series(summary, found, spanned).items():
        maps[label] = np.full((len(y.labels), len(x.labels)), np.nan)
        for one in group:
            if wanted.metric in one.estimates:
                row, column = (axis.labels.index(one.point.labels[axis.name]) for axis in (y, x))
                maps[label][row, column] = one.estimates[wanted.metric].mean
    figure = heat_map_figure(maps, (x.called, x.labels), (y.called, y.labels), wanted.metric)
    return figure, f"{_title(wanted.metric)} over {x.called} and {y.called}: means"


def _distribution(
    summary: CampaignSummary, found: Sequence[GridPointResult],
    wanted: campaign_file.Distribution, store: Store,
) -> tuple[Figure, str]:  # fmt: skip
    series = {
        label: runs_at(one.point, store)[0][wanted.metric]
        for label, group in _series(summary, found, tuple(wanted.where)).items()
        for one in group if wanted.metric in one.estimates
    }  # fmt: skip
    return distribution_figure(series, wanted.metric), (
        f"{_title(wanted.metric)}: the share of runs in which it is at most so much"
    )


def _series(
    summary: CampaignSummary, found: Sequence[GridPointResult], spanned: tuple[str, ...]
) -> dict[str, list[GridPointResult]]:
    """Group grid points by the values of the axes that the figure does not show as coordinates."""
    rest = [axis for axis in summary.campaign.axes if axis.name not in spanned]
    groups: dict[str, list[GridPointResult]] = {}
    for one in found:
        label = ", ".join(
            one.point.labels[axis.name] if axis.numbers is None
            else f"{axis.called} = {one.point.labels[axis.name]}"
            for axis in rest
        )  # fmt: skip
        groups.setdefault(label, []).append(one)
    return groups


def _panel(
    labels: Sequence[str], *, markers: bool = True
) -> tuple[Figure, Axes, list[dict[str, Any]]]:
    """Return a figure of one panel with the legend of its series, and the style of each series."""
    figure, (axes,) = single(_HEIGHT_IN, labels, titled=False)
    styles = [
        {
            "color": printed(palette.SERIES[i % len(palette.SERIES)]),
            "marker": _MARKERS[i % len(_MARKERS)] if markers else "",
            "linestyle": _DASHES[i % len(_DASHES)],
        }
        for i in range(len(labels))
    ]
    handles = [Line2D([], [], **style) for style in styles]
    names = [plain(label, _LONGEST_LABEL) for label in labels]
    legend(axes, list(zip(handles, names, strict=True)))
    return figure, axes, styles


def _means(estimates: Sequence[Estimate | None]) -> tuple[Vector, Vector]:
    """Return means and half-widths, (k,); NaN and 0 where there is none."""
    mean = np.array([e.mean if e and math.isfinite(e.mean) else np.nan for e in estimates])
    half = [e.halfwidth if e and math.isfinite(e.halfwidth) else 0.0 for e in estimates]
    return mean, np.array(half)


def _title(metric: Metric) -> str:
    title = METRICS[metric].title
    return title[0].upper() + title[1:]


def _scale(
    axes: Axes, which: Literal["x", "y"], values: Sequence[float] | Vector, metric: Metric
) -> None:
    """Use a logarithmic axis if the finite values are positive and far apart."""
    known = np.asarray(values)
    if METRICS[metric].logarithmic and _far(known[np.isfinite(known)]):
        logarithmic(axes, which)


def _far(values: Vector) -> bool:
    return bool(len(values) and values.min() > 0 and values.max() > _FAR * values.min())


def _numbers(axes: Axes, values: Matrix, drawn: Any) -> None:
    for (row, column), value in np.ndenumerate(values):
        if np.isfinite(value):
            colour = "#ffffff" if float(drawn.norm(value)) < 0.6 else "#000000"
            text = f"{value:.3g}"
            axes.text(
                column + 0.5, row + 0.5, text, ha="center", va="center", size=7.5, color=colour
            )
