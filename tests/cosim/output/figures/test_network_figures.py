"""The figures of loops that share a network, against the numbers that they show."""

import numpy as np
import pytest

from cosim.analysis.summary.loops_over_time import LoopsOverTime
from cosim.output.figures.figure_description import Band, FigureDescription, Heat, Item, Line
from cosim.output.figures.network_figures import MOST_CURVES, error_map, norms_figure

INTERVALS = 40
RNG = np.random.default_rng(1)


def over_time(loops: int) -> LoopsOverTime:
    errors, states = RNG.uniform(0.1, 1.0, (2, loops, INTERVALS))
    return LoopsOverTime(np.linspace(0.0, 4.0, INTERVALS + 1), errors, states, np.ones((loops, INTERVALS)))


def names(loops: int) -> list[str]:
    return [f"loop {number}" for number in range(loops)]


def items(figure: FigureDescription, row: int = 0) -> list[Item]:
    (panel,) = figure.rows[row].panels
    return list(panel.items)


def test_each_of_a_few_loops_has_a_curve() -> None:
    loops = over_time(MOST_CURVES)
    figure = norms_figure(loops, names(MOST_CURVES), np.ones(MOST_CURVES, bool))
    for row, values in enumerate((loops.errors, loops.states)):
        for curve, name, expected in zip(items(figure, row), names(MOST_CURVES), values, strict=True):
            assert isinstance(curve, Line)
            assert curve.label == name
            np.testing.assert_array_equal(curve.y, expected)


def test_many_loops_are_drawn_as_quantiles() -> None:
    loops = over_time(MOST_CURVES + 20)
    figure = norms_figure(loops, names(MOST_CURVES + 20), np.ones(MOST_CURVES + 20, bool))
    wide, narrow, median, largest = items(figure)
    for band, shares in ((wide, (0.05, 0.95)), (narrow, (0.25, 0.75))):
        assert isinstance(band, Band)
        low, high = np.quantile(loops.errors, shares, axis=0)
        np.testing.assert_allclose(band.low, low)
        np.testing.assert_allclose(band.high, high)
    for line, expected in ((median, np.median(loops.errors, axis=0)), (largest, loops.errors.max(axis=0))):
        assert isinstance(line, Line)
        np.testing.assert_allclose(line.y, expected)


def heat_of(figure: FigureDescription) -> Heat:
    (heat,) = items(figure)
    assert isinstance(heat, Heat)
    return heat


def test_the_colours_of_the_map_are_scaled_to_loops_that_did_not_diverge() -> None:
    loops = over_time(3)
    loops.errors[2, 5:] = 1e9
    figure = error_map(loops, names(3), np.array([True, True, False]))
    assert figure.scale is not None
    assert (figure.scale.low, figure.scale.high) == (loops.errors[:2].min(), loops.errors[:2].max())
    assert figure.scale.exceeded
    np.testing.assert_array_equal(heat_of(figure).values, loops.errors)


def test_an_error_of_zero_has_the_lowest_colour_and_an_unknown_one_none() -> None:
    loops = over_time(2)
    loops.errors[0, :2], loops.errors[1, 0] = np.nan, 0.0
    figure = error_map(loops, names(2), np.ones(2, bool))
    assert figure.scale is not None
    values = heat_of(figure).values
    assert values[1, 0] == figure.scale.low == np.nanmin(loops.errors[loops.errors > 0])
    assert np.isnan(values[0, :2]).all()
    assert np.isfinite(values).sum() == values.size - 2


@pytest.mark.parametrize("error", [0.0, np.nan])
def test_a_map_without_errors_has_no_colours(error: float) -> None:
    loops = over_time(2)
    loops.errors[:] = error
    figure = error_map(loops, names(2), np.ones(2, bool))
    assert figure.scale is None
    assert items(figure) == []
