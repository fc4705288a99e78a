"""The figures of a campaign."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cosim.output.figures.figure_files import inline
from cosim.output.figures.page_figure import PageFigure, one_panel
from cosim.studies.campaign.campaign_figures import (
    draw_distribution,
    draw_heat_maps,
    draw_means,
    draw_pareto,
    undominated,
)
from cosim.studies.campaign.campaign_report import metric_text
from cosim.studies.campaign.metrics import estimate
from tests.cosim.studies.campaign.conftest import HOSTILE


def one(draw: Callable[..., None], *shown: Any) -> PageFigure:
    return one_panel("figure", 2.0, lambda axes: draw(axes, *shown))


points = st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=1, max_size=12)


@given(points)
def test_the_front_is_what_nothing_dominates(drawn: list[tuple[int, int]]) -> None:
    x, y = np.array(drawn, dtype=float).T
    front = {(x[i], y[i]) for i in undominated(x, y)}
    expected = {
        (a, b) for a, b in drawn
        if not any((c <= a and d <= b) and (c, d) != (a, b) for c, d in drawn)
    }  # fmt: skip
    assert front == expected
    assert len(undominated(x, y)) == len(expected)
    assert (np.diff(x[undominated(x, y)]) > 0).all()


def test_figures_and_texts_accept_infinite_single_and_many_values() -> None:
    never, single = estimate(np.full(4, math.inf)), estimate(np.array([2.0]))
    assert metric_text("cost", never) == "never"
    assert metric_text("cost", estimate(np.array([1.0, 3.0]))) == "2 ± 13"
    assert metric_text("cost", estimate(np.array([-1.0, math.inf]))) == "−1 (50 % of runs)"
    assert metric_text("certificate_used", estimate(np.array([0.5]))) == "50"
    many = estimate(np.geomspace(1e-9, 1e9, 50))
    drawn = []
    for values in ([never], [never, single, many]):
        labels = [str(i) for i in range(len(values))]
        series = {f"series {i}": values for i in range(12)}
        pairs = {name: (values, list(reversed(values))) for name in series}
        drawn += [
            one(draw_pareto, pairs, "transmissions", "cost"),
            one(draw_means, None, labels, series, HOSTILE, "cost"),
        ]
    drawn.append(one(draw_means, np.array([1.0]), ["1"], {"a": [single]}, "x", "settling_s"))
    for matrix in (np.full((2, 3), np.nan), np.array([[1.0, np.nan, 1e9]])):
        rows = (("x", ["a", "b", "c"]), ("y", ["d", "e"][: len(matrix)]))
        maps = {f"map {i}": matrix for i in range(4)}
        drawn.append(
            PageFigure(
                name="maps",
                draw_panels=partial(draw_heat_maps, maps=maps, x=rows[0], y=rows[1], metric="cost"),
            )
        )
    samples = {"a": np.full(3, math.inf), "b": np.array([1.0]), "c": np.geomspace(1e-3, 1e3, 9)}
    drawn.append(one(draw_distribution, samples, "cost"))
    for figure in drawn:
        assert inline(figure).startswith("<svg")
