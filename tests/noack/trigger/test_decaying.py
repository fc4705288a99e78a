import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from noack.trigger.decaying import DecayingTrigger


@given(st.floats(1e-3, 1e3), st.floats(1e-3, 10), st.integers(0, 60 * 10**9))
def test_the_threshold_decays_exponentially_from_beta(beta: float, alpha: float, t_ns: int) -> None:
    trigger = DecayingTrigger(beta, alpha)
    assert trigger.threshold(0) == beta
    # The exponent, up to 600, passes its rounding error on to the result.
    assert trigger.threshold(t_ns) == pytest.approx(
        beta * math.e ** (-alpha * t_ns / 1e9), rel=1e-12
    )


def test_the_threshold_never_falls_below_its_floor() -> None:
    trigger = DecayingTrigger(0.5, 0.25, 0.125)
    meets_ns = round(math.log(4) / 0.25 * 1e9)  # 0.5 e^{-t/4} = 0.125
    assert trigger.threshold(meets_ns - 1_000_000) > 0.125
    assert trigger.threshold(meets_ns + 1_000_000) == 0.125
    assert trigger.threshold(10**18) == 0.125
    assert DecayingTrigger(0.5, 0.25).threshold(10**18) == 0.0  # the paper's rule has none


def test_the_error_is_measured_in_the_weighted_norm() -> None:
    e_s = np.array([3.0, -4.0])
    assert DecayingTrigger(1.0, 1.0).error_norm(e_s) == 5.0
    weight = np.array([[2.0, 0.0], [1.0, 1.0]])  # W e = (6, −1); its transpose gives (2, −4)
    assert DecayingTrigger(1.0, 1.0, weight=weight).error_norm(e_s) == pytest.approx(math.sqrt(37))
