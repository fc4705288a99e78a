"""The figures of a campaign; intervals are 95 % confidence intervals of the means."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cosim.output import palette
from cosim.output.report.axes import (
    BELOW_IN,
    LEFT_IN,
    WIDTH_IN,
    Shown,
    finish,
    head_in,
    legend,
    logarithmic,
    place,
    plain,
    single,
)
from cosim.output.report.figure_style import printed, styled
from cosim.studies.campaign import campaign_file
from cosim.studies.campaign.campaign_summary import CampaignSummary, GridPointResult, runs_at
from cosim.studies.campaign.chunk_store import Store
from cosim.studies.campaign.draw_statistics import Estimate
from cosim.studies.campaign.metrics import METRICS, Metric
from noack.core.linear_systems import Matrix, Vector

_HEIGHT_IN = 3.4
_MAP_HEIGHT_IN, _MAPS_IN_A_ROW, _BAR_IN = 2.4, 3, 0.16
_QUANTILES = 400
_NARROWEST_IN = 0.42
"""Narrowest cell of a map in which its number is written, in inches."""
_FAR = 10.0
"""A metric with values further apart than this factor gets a logarithmic axis."""
_LONGEST_LABEL = 28
_MARKERS = "os^Dv<>PXph*"
_DASHES: tuple[Any, ...] = ("-", (0, (6, 1.5)), (0, (2, 1.2)), (0, (6, 1.5, 1.5, 1.5)))


class Drawn(NamedTuple):
    """A figure of the page."""

    name: str
    """Name of the figure, one word."""
    figure: Figure
    caption: str


def figures(summary: CampaignSummary, store: Store) -> Iterator[Drawn]:
    """Draw the figures that the campaign asks for."""
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
        yield Drawn(f"{wanted.kind.replace('_', '-')}-{i + 1}", figure, f"{caption}{where}.")


@styled
def pareto_figure(
    series: Mapping[str, tuple[Sequence[Estimate], Sequence[Estimate]]], x: Metric, y: Metric
) -> Figure:
    """Draw means of y against means of x, with intervals; a line joins the non-dominated points."""
    figure, (axes,) = single(_HEIGHT_IN, list(series))
    shown: list[Shown] = []
    for i, (label, pair) in enumerate(series.items()):
        (xs, ys), (dx, dy) = (
            [np.array([getattr(e, name) for e in es]) for es in pair]
            for name in ("mean", "halfwidth")
        )
        style = _style(i)
        kept = np.flatnonzero(np.isfinite(xs) & np.isfinite(ys))
        xs, ys, dx, dy = (values[kept] for values in (xs, ys, dx, dy))
        axes.errorbar(
            xs, ys, np.where(np.isfinite(dy), dy, 0.0), np.where(np.isfinite(dx), dx, 0.0),
            linestyle="none", marker=style["marker"], color=style["color"], elinewidth=1.0,
            markersize=5,
        )  # fmt: skip
        front = undominated(xs, ys)
        axes.plot(
            xs[front], ys[front], drawstyle="steps-post", color=style["color"],
            linestyle=style["linestyle"],
        )  # fmt: skip
        shown.append((Line2D([], [], **style), plain(label, _LONGEST_LABEL)))
    axes.set(xlabel=METRICS[x].label, ylabel=METRICS[y].label)
    _scale(axes, "x", [e for xs, _ in series.values() for e in xs], x)
    _scale(axes, "y", [e for _, ys in series.values() for e in ys], y)
    legend(axes, shown)
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

    Args:
        x: values of the axis, (k,); None if they are not numbers.
        labels: k labels of these values.
        series: k estimates by name of the series; None if there is no estimate.
        axis: title of the axis.
        metric: the metric.
    """
    figure, (axes,) = single(_HEIGHT_IN, list(series))
    at = np.arange(len(labels), dtype=np.float64) if x is None else x
    order = np.argsort(at)
    shown: list[Shown] = []
    for i, (label, estimates) in enumerate(series.items()):
        style = _style(i)
        mean, half = (
            np.array([getattr(estimates[j], name, np.nan) for j in order])
            for name in ("mean", "halfwidth")
        )
        mean, half = np.where(np.isfinite(mean), mean, np.nan), np.where(np.isfinite(half), half, 0)
        axes.plot(at[order], mean, markersize=4, **style)
        axes.fill_between(
            at[order], mean - half, mean + half, color=style["color"], alpha=0.25, linewidth=0
        )
        shown.append((Line2D([], [], **style), plain(label, _LONGEST_LABEL)))
    if x is None:
        axes.set_xticks(at, [plain(label) for label in labels])
    axes.set(xlabel=plain(axis, _LONGEST_LABEL), ylabel=METRICS[metric].label)
    _scale(axes, "y", [e for estimates in series.values() for e in estimates if e], metric)
    legend(axes, shown)
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

    Args:
        maps: by title, (values of y, values of x); NaN is a missing value.
        x: title and labels of the horizontal axis.
        y: title and labels of the vertical axis.
        metric: the metric.
    """
    columns = min(len(maps), _MAPS_IN_A_ROW)
    rows = -(-len(maps) // columns)
    above_in, gap_in = head_in(()), 0.15
    longest = max(len(plain(label)) for label in y[1])
    left_in = max(LEFT_IN, 0.45 + 0.085 * longest)
    width_in = (WIDTH_IN - left_in - 1.1 - gap_in * (columns - 1)) / columns
    row_in = above_in + _MAP_HEIGHT_IN
    figure = Figure(figsize=(WIDTH_IN, rows * row_in + BELOW_IN + 0.25))
    norm, known = _norm(np.stack(list(maps.values())), metric)
    for i, (title, values) in enumerate(maps.items()):
        row, column = divmod(i, columns)
        axes = place(
            figure, left_in + column * (width_in + gap_in), row * row_in + above_in,
            width_in, _MAP_HEIGHT_IN,
        )  # fmt: skip
        drawn = axes.pcolormesh(np.ma.masked_invalid(values), norm=norm, cmap="viridis")
        if width_in >= _NARROWEST_IN * values.shape[1]:
            _numbers(axes, values, drawn)
        axes.grid(visible=False)
        last = i + columns >= len(maps)
        _ticks(axes, "x", x[1], labelled=last)
        _ticks(axes, "y", y[1], labelled=column == 0)
        axes.set(
            title=plain(title, _LONGEST_LABEL),
            xlabel=plain(x[0], _LONGEST_LABEL) if last else "",
            ylabel=plain(y[0], _LONGEST_LABEL) if column == 0 else "",
        )
    if known:
        bar = place(figure, WIDTH_IN - 1.0, above_in, _BAR_IN, _MAP_HEIGHT_IN)
        figure.colorbar(drawn, cax=bar, label=METRICS[metric].label)
        bar.grid(visible=False)
    return figure


@styled
def distribution_figure(series: Mapping[str, Vector], metric: Metric) -> Figure:
    """Draw the cumulative distribution of a metric; infinite values keep a curve below 1.

    Args:
        series: values of all runs by name of the series, (k,), without NaN.
        metric: the metric.
    """
    figure, (axes,) = single(_HEIGHT_IN, list(series))
    share = np.linspace(0.0, 1.0, _QUANTILES + 1)
    shown: list[Shown] = []
    finite = []
    for i, (label, values) in enumerate(series.items()):
        style = {key: value for key, value in _style(i).items() if key != "marker"}
        at = np.quantile(values, share, method="inverted_cdf")
        seen = np.isfinite(at)
        finite.append(at[seen])
        axes.plot(at[seen], share[seen], drawstyle="steps-post", **style)
        shown.append((Line2D([], [], **style), plain(label, _LONGEST_LABEL)))
    axes.set(xlabel=METRICS[metric].label, ylabel="share of runs", ylim=(0, 1.02))
    if METRICS[metric].logarithmic and _far(np.concatenate(finite)):
        logarithmic(axes, "x")
    legend(axes, shown)
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
    numbers = None if axis.numbers is None else np.array(axis.numbers)
    place = summary.campaign.axes.index(axis)
    kept = sorted({one.point.place[place] for one in found if wanted.metric in one.estimates})
    series: dict[str, list[Estimate | None]] = {}
    for label, group in _series(summary, found, (wanted.x, *wanted.where)):
        known = {one.point.place[place]: one.estimates.get(wanted.metric) for one in group}
        if any(known.values()):
            series[label] = [known.get(i) for i in kept]
    figure = curve_figure(
        None if numbers is None else numbers[kept],
        [axis.labels[i] for i in kept],
        series,
        axis.called,
        wanted.metric,
    )
    return figure, (
        f"{_title(wanted.metric)} over {axis.called}: means and 95 % confidence intervals"
    )


def _heat_map(
    summary: CampaignSummary, found: Sequence[GridPointResult], wanted: campaign_file.HeatMap
) -> tuple[Figure, str]:
    axes = [summary.campaign.by_name[name] for name in (wanted.x, wanted.y)]
    places = [summary.campaign.axes.index(axis) for axis in axes]
    maps = {}
    for label, group in _series(summary, found, (wanted.x, wanted.y, *wanted.where)):
        values = np.full([len(axis.labels) for axis in reversed(axes)], np.nan)
        for one in group:
            if wanted.metric in one.estimates:
                column, row = (one.point.place[place] for place in places)
                mean = one.estimates[wanted.metric].mean
                values[row, column] = mean if np.isfinite(mean) else np.nan
        maps[label] = values
    x, y = ((axis.called, axis.labels) for axis in axes)
    return heat_map_figure(maps, x, y, wanted.metric), (
        f"{_title(wanted.metric)} over {x[0]} and {y[0]}: means"
    )


def _distribution(
    summary: CampaignSummary,
    found: Sequence[GridPointResult],
    wanted: campaign_file.Distribution,
    store: Store,
) -> tuple[Figure, str]:
    series = {
        label: runs_at(one.point, store)[0][wanted.metric]
        for label, group in _series(summary, found, tuple(wanted.where))
        for one in group if wanted.metric in one.estimates
    }  # fmt: skip
    return distribution_figure(series, wanted.metric), (
        f"{_title(wanted.metric)}: the share of runs in which it is at most so much"
    )


def _series(
    summary: CampaignSummary, found: Sequence[GridPointResult], spanned: tuple[str, ...]
) -> Iterator[tuple[str, list[GridPointResult]]]:
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
    yield from groups.items()


def _style(i: int) -> dict[str, Any]:
    return {
        "color": printed(palette.SERIES[i % len(palette.SERIES)]),
        "marker": _MARKERS[i % len(_MARKERS)],
        "linestyle": _DASHES[i % len(_DASHES)],
    }


def _title(metric: Metric) -> str:
    title = METRICS[metric].title
    return title[0].upper() + title[1:]


def _scale(axes: Axes, which: Any, estimates: Sequence[Estimate], metric: Metric) -> None:
    """Use a logarithmic axis if the values are positive and far apart."""
    means = np.array([e.mean for e in estimates if np.isfinite(e.mean)])
    if METRICS[metric].logarithmic and _far(means):
        logarithmic(axes, which)


def _far(values: Vector) -> bool:
    return bool(len(values) and values.min() > 0 and values.max() > _FAR * values.min())


def _norm(values: Matrix, metric: Metric) -> tuple[Any, bool]:
    from matplotlib.colors import LogNorm, Normalize

    known = values[np.isfinite(values)]
    if not len(known):
        return None, False
    low, high = float(known.min()), float(known.max())
    kind = LogNorm if METRICS[metric].logarithmic and _far(known) else Normalize
    return kind(low, high), True


def _numbers(axes: Axes, values: Matrix, drawn: Any) -> None:
    for (row, column), value in np.ndenumerate(values):
        if np.isfinite(value):
            dark = float(drawn.norm(value)) < 0.6
            axes.text(
                column + 0.5, row + 0.5, f"{value:.3g}", ha="center", va="center", size=7.5,
                color="#ffffff" if dark else "#000000",
            )  # fmt: skip


def _ticks(axes: Axes, which: Any, labels: Sequence[str], *, labelled: bool) -> None:
    axis = axes.xaxis if which == "x" else axes.yaxis
    written = [plain(label) if labelled else "" for label in labels]
    axis.set_ticks(np.arange(len(labels)) + 0.5, written)
    axes.tick_params(axis=which, length=0)
