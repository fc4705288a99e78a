"""The core's elementary functions: as accurate as they claim, and defined for all numbers."""

import math
from collections.abc import Callable
from decimal import Decimal, localcontext

import numpy as np
import pytest
from scipy.special import ndtr, ndtri

from noack.core.core_library import core

Function = Callable[[Decimal], Decimal]
COUNT = 3000
"""Of random arguments in each range; a million of each were compared when the code was written."""
EXACT: dict[str, Function] = {
    "exp": Decimal.exp,
    "expm1": lambda x: x.exp() - 1,
    "log": Decimal.ln,
    "cube_root": lambda x: (x.ln() / 3).exp(),
}


def _uniform(low: float, high: float) -> Callable[[np.random.Generator], np.ndarray]:
    return lambda rng: rng.uniform(low, high, COUNT)


def _any_size(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(0.5, 1.0, COUNT) * 2.0 ** rng.integers(-1073, 1024, COUNT)


def _near(center: float, largest: int) -> Callable[[np.random.Generator], np.ndarray]:
    def draw(rng: np.random.Generator) -> np.ndarray:
        return center + rng.choice([-1.0, 1.0], COUNT) * 2.0 ** rng.uniform(-52, largest, COUNT)

    return draw


@pytest.mark.parametrize(
    ("name", "draw", "most_ulps"),
    [
        ("exp", _uniform(-708, 709.7), 0.501),
        ("exp", _uniform(-3, 3), 0.501),
        ("exp", _near(0.0, -1), 0.501),
        ("exp", _uniform(-745.1, -707), 0.501),  # subnormal
        ("expm1", _uniform(-40, 100), 0.502),
        ("expm1", _uniform(-2, 2), 0.515),
        ("expm1", _near(0.0, -1), 0.515),
        ("log", _any_size, 0.501),
        ("log", _uniform(0.4, 2.1), 0.501),
        ("log", _near(1.0, -4), 0.501),
        ("cube_root", _any_size, 0.501),
        ("cube_root", _uniform(0.4, 8.1), 0.501),
    ],
)
def test_errors_in_units_of_the_last_place(
    name: str, draw: Callable[[np.random.Generator], np.ndarray], most_ulps: float
) -> None:
    function = getattr(core, f"noack_{name}")
    with localcontext() as context:
        context.prec = 60
        for x in draw(np.random.default_rng(1)).tolist():
            expected = EXACT[name](Decimal(x))
            ulp = Decimal(math.ulp(float(expected)))
            assert abs(Decimal(function(x)) - expected) <= Decimal(most_ulps) * ulp, x


@pytest.mark.parametrize("name", ["exp", "expm1", "log"])
def test_special_values(name: str) -> None:
    """They are as the C standard's Annex F has them."""
    function, reference = getattr(core, f"noack_{name}"), getattr(math, name)
    values = [0.0, -0.0, math.inf, -math.inf, math.nan, 1.0, -1.0, 5e-324, -5e-324]
    values += [709.782712893384, 709.7827128933841, -745.1332191019411, -745.1332191019412]
    values += [-708.3964185322641, 1e300, -1e300, 1.7976931348623157e308, 2.2250738585072014e-308]
    for x in values:
        try:
            expected = reference(x)
        except OverflowError:
            expected = math.inf
        except ValueError:
            expected = -math.inf if x == 0.0 else math.nan
        found = function(x)
        assert found == pytest.approx(expected, rel=3e-16, abs=0.0, nan_ok=True), x
        assert math.copysign(1.0, found) == math.copysign(1.0, expected) or math.isnan(found)


def test_the_normal_distribution_and_its_quantile_are_those_of_scipy() -> None:
    """Both tail branches and the middle; the upper half by symmetry where that is exact."""
    half = np.concatenate([np.geomspace(2.0**-54, 0.4999, 4000), np.linspace(0.001, 0.5, 4000)])
    score = np.vectorize(core.noack_normal_score)
    np.testing.assert_allclose(score(half), ndtri(half), rtol=1e-14, atol=1e-16)
    upper = 1.0 - half[half > 2.0**-53]
    np.testing.assert_allclose(score(upper), -ndtri(1.0 - upper), rtol=1e-14, atol=1e-16)
    # Relative error 1e-14 plus the effect of the argument's rounding, z² ulps.
    z = np.linspace(-8.3, 8.3, 5001)
    found = np.vectorize(core.noack_normal_cdf)(z)
    assert (np.abs(found / ndtr(z) - 1) <= 1e-15 * (2 + z**2)).all()
    # The scores of 0 and 1 are finite.
    ends = score([0.0, 2.0**-53, 2.0**-52, 0.5, 1 - 2.0**-53, 1.0])
    assert (np.diff(ends) > 0).all()
    assert (ends[0], ends[3]) == (-ends[-1], 0.0)
    assert ends[0] == pytest.approx(ndtri(2.0**-54), rel=1e-14)


def test_cube_roots_of_cubes_and_special_values() -> None:
    for k in range(1, 2000):
        assert core.noack_cube_root(float(k**3)) == k
        assert core.noack_cube_root(float(k**3) * 2.0**-300) == k * 2.0**-100
    assert core.noack_cube_root(0.0) == 0.0
    assert core.noack_cube_root(math.inf) == math.inf
    assert math.isnan(core.noack_cube_root(-1.0))
    assert math.isnan(core.noack_cube_root(math.nan))


def test_the_exponential_does_not_decrease() -> None:
    """Searches for crossings rely on it up to rounding."""
    for begin in (-1.0, -0.0108304, 0.0, 0.0108304, 0.69314, 5.0, -700.0):
        x = begin + np.arange(3000) * math.ulp(begin or 1.0) * 4
        found = [core.noack_exp(value) for value in x.tolist()]
        assert found == sorted(found)
