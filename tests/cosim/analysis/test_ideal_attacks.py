"""Bounds for the paper's conditions against losses in the loop without delays."""

import pytest

from cosim.analysis.scenario_certificates import quick_certificate
from tests.helpers.shipped import resolved
from tests.oracles.paper_attacks import largest_share


@pytest.mark.parametrize("name", ["lane_following", "double_integrator", "unstable_pendulum"])
def test_no_losses_exceed_a_bound_for_the_papers_conditions(name: str) -> None:
    loop = resolved(name, "horizon_s=6")
    certificate = quick_certificate(loop, ideal=True)
    assert certificate.exists
    assert 0.05 < largest_share(loop, certificate, 25) <= 1.0


def test_a_bound_that_forgets_a_loss_is_refuted() -> None:
    loop = resolved("lane_following", "network.mansd=1")
    without = loop.network.model_copy(update={"mansd": 0})
    broken = quick_certificate(loop.model_copy(update={"network": without}), ideal=True)
    assert largest_share(loop, broken, 25) > 1.0
