"""The figures of loops that share a network, against the numbers that they show."""

from collections.abc import Callable

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cosim.analysis.summary.loops_over_time import LoopsOverTime
from cosim.output.figures.network_figures import MOST_CURVES, draw_norms
from cosim.output.figures.page_figure import PageFigure
from cosim.output.figures.panels import Panels

INTERVALS = 40
RNG = np.random.default_rng(1)


def over_time(loops: int) -> LoopsOverTime:
    errors, states = RNG.uniform(0.1, 1.0, (2, loops, INTERVALS))
    return LoopsOverTime(np.linspace(0.0, 4.0, INTERVALS + 1), errors, states, np.ones((loops, INTERVALS)))


def names(loops: int) -> list[str]:
    return [f"loop {number}" for number in range(loops)]


def drawn(draw: Callable[..., list[Panels]], loops: LoopsOverTime, is_bounded: np.ndarray) -> Figure:
    named = names(len(loops.errors))
    return PageFigure(name="loops", draw_panels=lambda figure: draw(figure, loops, named, is_bounded)).draw()


def labels(axes: Axes) -> list[str]:
    return [*dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))]


def test_each_of_a_few_loops_has_a_curve() -> None:
    loops = over_time(MOST_CURVES)
    figure = drawn(draw_norms, loops, np.ones(MOST_CURVES, bool))
    for axes, values in zip(figure.axes, (loops.errors, loops.states), strict=True):
        assert labels(axes) == names(MOST_CURVES)
        for line, expected in zip(axes.lines, values, strict=True):
            np.testing.assert_array_equal(line.get_ydata(), expected)


def test_many_loops_are_drawn_as_quantiles() -> None:
    loops = over_time(MOST_CURVES + 20)
    axes = drawn(draw_norms, loops, np.ones(MOST_CURVES + 20, bool)).axes[0]
    for band, shares in zip(axes.collections, ((0.05, 0.95), (0.25, 0.75)), strict=True):
        low, high = np.quantile(loops.errors, shares, axis=0)
        corners = band.get_paths()[0].get_extents()
        assert (corners.y0, corners.y1) == pytest.approx((low.min(), high.max()))
    median, largest = axes.lines
    np.testing.assert_allclose(np.asarray(median.get_ydata(), float), np.median(loops.errors, axis=0))
    np.testing.assert_allclose(np.asarray(largest.get_ydata(), float), loops.errors.max(axis=0))
