"""The quick bounds of growth, against the exact maps."""

import numpy as np
import pytest

from cosim.studies.design.network_search import DesignRequest, NetworkSearch
from cosim.studies.design.quick_estimate import PatternGraph
from noack.scenario.resolution import resolve
from noack.theory.margins.loss_margin import LossMargin
from tests.helpers.shipped import shipped


def test_quick_bounds_are_those_of_the_exact_maps() -> None:
    settings = ("network.impairments=[{kind='delay', delay_s=0.0333}]", "controller.rate_hz=40")
    timeouts = [
        ("mode=zoh", "controller.update_timeout_s=0.31"),
        (*settings, "controller.update_timeout_s=0.65", 'controller.timeout_input="hold"'),
        (*settings, "controller.update_timeout_s=0.62", "controller.phase=0.9"),
    ]
    for more in ((), settings, (*settings, "mode=zoh"), *timeouts):
        given = shipped("double_integrator", *more)
        search = NetworkSearch(given, DesignRequest(period_s=0.31))
        exact = LossMargin(resolve(search.scenario))
        bursts = exact.bursts(search.guarantee(5))
        quick = search.quick_loop(search.given_gain).maps(bursts)
        maps = np.array([exact.maps(burst.slot, burst.usable, burst.losses).middle for burst in bursts])
        if not more or more == timeouts[0]:
            np.testing.assert_allclose(quick, maps, rtol=0, atol=1e-11 * np.abs(maps).max())
        stability = exact.coarse_bounds(search.guarantee(5))
        lower = np.exp(PatternGraph(bursts).growth(quick))
        assert lower <= stability.upper
        assert lower == pytest.approx(stability.lower, rel=2e-2)
