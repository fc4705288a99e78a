"""The core's elementary functions and random numbers: as accurate as they claim, and defined."""

import math
from collections.abc import Callable
from decimal import Decimal, localcontext

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ndtr, ndtri

from netem.core.core_library import core, ffi
from netem.core.random_streams import uniform_pair

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
def test_errors_are_within_the_stated_units_in_the_last_place(
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
def test_special_values_are_those_of_the_c_standard(name: str) -> None:
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
        result = function(x)
        assert result == pytest.approx(expected, rel=3e-16, abs=0.0, nan_ok=True), x
        assert math.copysign(1.0, result) == math.copysign(1.0, expected) or math.isnan(result)


def test_the_normal_distribution_and_its_quantile_are_those_of_scipy() -> None:
    """Both tail branches and the middle; the upper half by symmetry where that is exact."""
    half = np.concatenate([np.geomspace(2.0**-54, 0.4999, 4000), np.linspace(0.001, 0.5, 4000)])
    score = np.vectorize(core.noack_normal_score)
    np.testing.assert_allclose(score(half), ndtri(half), rtol=1e-14, atol=1e-16)
    upper = 1.0 - half[half > 2.0**-53]
    np.testing.assert_allclose(score(upper), -ndtri(1.0 - upper), rtol=1e-14, atol=1e-16)
    # Relative error 1e-14 plus the effect of the argument's rounding, z² ulps.
    z = np.linspace(-8.3, 8.3, 5001)
    probabilities = np.vectorize(core.noack_normal_cdf)(z)
    assert (np.abs(probabilities / ndtr(z) - 1) <= 1e-15 * (2 + z**2)).all()
    # The scores of 0 and 1 are finite.
    ends = score([0.0, 2.0**-53, 2.0**-52, 0.5, 1 - 2.0**-53, 1.0])
    assert (np.diff(ends) > 0).all()
    assert (ends[0], ends[3]) == (-ends[-1], 0.0)
    assert ends[0] == pytest.approx(ndtri(2.0**-54), rel=1e-14)


def test_cube_roots_of_cubes_are_exact() -> None:
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
        results = [core.noack_exp(value) for value in x.tolist()]
        assert results == sorted(results)


ONES = 0xFFFFFFFF
WORDS = st.integers(0, ONES)


def philox(c0: int, c1: int, c2: int, c3: int, k0: int, k1: int) -> tuple[int, ...]:
    words = ffi.new("int64_t[4]")
    core.noack_philox([c0, c1, c2, c3], [k0, k1], words)
    return tuple(words)


def test_the_known_answers_of_random123() -> None:
    """From kat_vectors of the authors' library: zeros, ones, digits of pi."""
    assert philox(*[0] * 6) == (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)
    assert philox(*[ONES] * 6) == (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)
    pi = (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344, 0xA4093822, 0x299F31D0)
    assert philox(*pi) == (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1)


@given(WORDS, WORDS, WORDS, st.integers(0, 2**63 - 1), st.integers(0, 3))
def test_uniform_numbers_are_the_words_of_the_counter(
    key0: int, key1: int, flow: int, packet: int, block: int
) -> None:
    a, b, c, d = philox(packet & ONES, packet >> 32, flow, block, key0, key1)
    expected = tuple(((x << 32 | y) >> 11) / 2**53 for x, y in ((a, b), (c, d)))
    pair = uniform_pair(key0, key1, flow, packet, block)
    assert all(0 <= u < 1 and u * 2**53 == int(u * 2**53) for u in pair)
    # Upper 27 bits: from the first word; lower 26 bits: the upper bits of the second word.
    for u, (x, y) in zip(pair, ((a, b), (c, d)), strict=True):
        assert divmod(int(u * 2**53), 2**26) == (x >> 5, y >> 6)
    assert np.allclose(pair, expected, rtol=0, atol=2**-27)
