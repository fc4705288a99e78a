"""The quick bounds of growth, against the exact maps."""

import numpy as np
import pytest

from cosim.analysis.mean_cost import CostUnder, find_mean_cost
from cosim.studies.design.network_search import DesignRequest, NetworkSearch
from cosim.studies.design.quick_estimate import PatternGraph
from noack.scenario.arrival_ties import with_later_updates
from noack.scenario.resolution import resolve
from noack.theory.witnesses.coordinates import floats
from noack.theory.witnesses.loss_margin import LossMargin
from tests.helpers.shipped import shipped


def test_quick_bounds_are_those_of_the_exact_maps() -> None:
    settings = ("network.impairments=[{kind='delay', delay_s=0.0333}]", "controller.rate_hz=40")
    timeouts = [
        ("mode=zoh", "controller.update_timeout_s=0.31"),
        (*settings, "controller.update_timeout_s=0.65", 'controller.timeout_input="hold"'),
        (*settings, "controller.update_timeout_s=0.62", "controller.phase=0.9"),
    ]
    ties = [
        ("network.impairments=[{kind='delay', delay_s=0.31}]", "controller.phase=0.0"),
        ("network.impairments=[{kind='delay', delay_s=0.1}]", "controller.rate_hz=50"),
        ("controller.rate_hz=50", "controller.phase=0.0", "mode=zoh"),
    ]
    delayed = [tuple(text.replace("0.0333", f"{d_s}") for text in settings) for d_s in (0.7, 0.93)]
    for more in ((), settings, (*settings, "mode=zoh"), *timeouts, *delayed, *ties):
        given = shipped("double_integrator", *more)
        search = NetworkSearch(given, DesignRequest(period_s=0.31))
        exact = LossMargin(resolve(search.scenario))
        loop = exact.bursts_loop.under(search.guarantee(5))
        bursts = loop.bursts
        quick = search.quick_loop(search.given_gain).maps(bursts)
        maps = np.array([floats(loop.matrix(burst)) for burst in bursts])
        if not more or more == timeouts[0]:
            np.testing.assert_allclose(quick, maps, rtol=0, atol=1e-11 * np.abs(maps).max())
        assert (more in ties) == bool(exact.ties)
        stability = exact.coarse_bounds(search.guarantee(5))
        lower = np.exp(PatternGraph(bursts).growth(quick))
        assert lower <= stability.upper
        assert lower == pytest.approx(stability.lower, rel=2e-2)


@pytest.mark.parametrize(("delay_s", "phase"), [(0.0, 0.5), (0.2, 0.5), (0.7, 0.5), (0.0, 0.0), (0.31, 0.0)])
def test_the_cost_without_losses_is_the_exact_one(delay_s: float, phase: float) -> None:
    settings = (
        f"network.impairments=[{{kind='delay', delay_s={delay_s}}}]",
        f"controller.phase={phase}",
        "network.loss={model='lossless'}",
    )
    given = shipped("double_integrator", *settings, "network.mansd=0", "network.initial_sync=known_state")
    search = NetworkSearch(given, DesignRequest(period_s=0.31))
    exact = find_mean_cost(resolve(with_later_updates(search.scenario)[0])).with_guarantee
    assert isinstance(exact, CostUnder)
    assert search.cost(search.given_gain) == pytest.approx(exact.transient_cost, rel=1e-6)
