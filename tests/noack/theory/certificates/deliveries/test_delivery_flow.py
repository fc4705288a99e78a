"""The rounding of the flow between two deliveries, against arithmetic of 384 binary digits."""

import math

import numpy as np
from hypothesis import given, settings

from noack.core.clock import NS_PER_S
from noack.core.linear_systems import Matrix
from noack.theory.certificates.deliveries.delivery_flow import FLOW_ROUNDING, DeliveryFlow
from noack.theory.margins.exact_matrices import exponential
from tests.noack.theory.certificates.certified_loops import gains_of
from tests.oracles.lossy_loops import SEARCH, System, systems


def exactly_after(generator: Matrix, t_s: float) -> Matrix:
    """Return e^{G t}, rounded once; t and G are taken as the numbers that they are."""
    mantissa, exponent = math.frexp(t_s)
    scaled = np.ldexp(generator, exponent - 53)
    return exponential(scaled, round(mantissa * 2**53) * NS_PER_S).interval().middle


@settings(SEARCH, max_examples=12)
@given(systems())
def test_the_error_of_the_flow_is_far_below_what_its_bounds_are_enlarged_by(
    system: System,
) -> None:
    """It is an estimate, not a proof: at most a tenth of what bounds are enlarged by."""
    flow = DeliveryFlow(gains_of(system))
    for node in np.linspace(1, len(flow.edges_s) - 1, 6).astype(int):
        exact = exactly_after(flow.generator, float(flow.edges_s[node]))
        error = np.linalg.norm(flow.states[node] - exact[:, : flow.n], 2)
        assert error <= (FLOW_ROUNDING - 1) / 10
