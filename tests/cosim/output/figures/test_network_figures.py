"""The figures of loops that share a network, against the numbers that they show."""

from collections.abc import Callable

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from cosim.analysis.summary.loops_over_time import LoopsOverTime
from cosim.output.figures.network_figures import MOST_CURVES, draw_error_map, draw_norms
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


def image_of(loops: LoopsOverTime, is_bounded: np.ndarray) -> AxesImage:
    (image,) = drawn(draw_error_map, loops, is_bounded).axes[0].images
    return image


def test_the_colours_of_the_map_are_scaled_to_loops_that_did_not_diverge() -> None:
    loops = over_time(3)
    loops.errors[2, 5:] = 1e9
    image = image_of(loops, np.array([True, True, False]))
    assert image.get_clim() == (loops.errors[:2].min(), loops.errors[:2].max())
    assert image.colorbar is not None
    assert image.colorbar.extend == "max"
    np.testing.assert_array_equal(np.asarray(image.get_array()), loops.errors)


def test_an_error_of_zero_has_the_lowest_colour_and_an_unknown_one_none() -> None:
    loops = over_time(2)
    loops.errors[0, :2], loops.errors[1, 0] = np.nan, 0.0
    image = image_of(loops, np.ones(2, bool))
    values: np.ndarray = np.ma.asarray(image.get_array()).filled(np.nan)
    assert values[1, 0] == image.get_clim()[0] == np.nanmin(loops.errors[loops.errors > 0])
    assert np.isnan(values[0, :2]).all()
    assert np.isfinite(values).sum() == values.size - 2


@pytest.mark.parametrize("error", [0.0, np.nan])
def test_a_map_without_errors_has_no_colours(error: float) -> None:
    loops = over_time(2)
    loops.errors[:] = error
    figure = drawn(draw_error_map, loops, np.ones(2, bool))
    (axes,) = figure.axes
    assert not axes.images
    assert [text.get_text() for text in axes.texts] == ["no data"]
