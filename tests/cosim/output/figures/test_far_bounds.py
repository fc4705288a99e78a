"""A bound far above an output is written beside the picture of its distance, and does not set its scale."""

import numpy as np
import pytest

import noack
from cosim.output.curves import Curve, CurveStyle
from cosim.output.figures.run_figures import _outputs


@pytest.mark.parametrize(("bound", "is_drawn"), [(30.0, True), (1e4, False)])
def test_a_far_bound_does_not_set_the_scale(bound: float, is_drawn: bool) -> None:
    run = noack.simulate(noack.load("lane_following", {"horizon_s": 0.1}))
    t_s = np.linspace(0.0, 0.1, 9)
    bounds = {
        name: [Curve("distance", "bound", "", t_s, np.full(9, bound), CurveStyle((0, 0, 0)))]
        for name in ("lateral offset", "heading")
    }
    axes = _outputs(run._record, bounds).draw(7.0).axes[0]  # about 3 m
    entries = [text.get_text() for text in axes.get_legend().get_texts()]
    assert ("bound: above 1e+04 m, not drawn" not in entries) is is_drawn
    assert ("bound" in entries) is is_drawn
    assert axes.get_ylim()[1] < 20 * 3.1
