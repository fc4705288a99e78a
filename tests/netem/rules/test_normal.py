"""Compare with SciPy's normal distribution."""

import math

import numpy as np
import pytest
from scipy.special import ndtr, ndtri

from noack.core.core_library import core

cdf, score = core.noack_normal_cdf, core.noack_normal_score
HALF = np.concatenate([np.geomspace(2.0**-54, 0.4999, 4000), np.linspace(0.001, 0.5, 4000)])


def test_the_score_is_the_quantile() -> None:
    """Both tail branches and the middle; the upper half by symmetry where that is exact."""
    found = np.array([score(u) for u in HALF.tolist()])
    np.testing.assert_allclose(found, ndtri(HALF), rtol=1e-14, atol=1e-16)
    upper = 1.0 - HALF[HALF > 2.0**-53]
    np.testing.assert_allclose(
        [score(u) for u in upper.tolist()], -ndtri(1.0 - upper), rtol=1e-14, atol=1e-16
    )


def test_the_distribution_function() -> None:
    """Relative error 1e-14 plus the effect of the argument's rounding, z² ulps."""
    z = np.linspace(-8.3, 8.3, 5001)
    found = np.array([cdf(value) for value in z.tolist()])
    assert (np.abs(found / ndtr(z) - 1) <= 1e-15 * (2 + z**2)).all()


def test_the_scores_of_0_and_1_are_finite() -> None:
    least, most = score(0.0), score(1.0)
    assert math.isfinite(least)
    assert most == -least
    assert least == pytest.approx(ndtri(2.0**-54), rel=1e-14)
    assert least < score(2.0**-53) < score(2.0**-52)
    assert score(1 - 2.0**-53) < most
    assert score(0.5) == 0.0
