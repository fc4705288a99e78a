"""Matrix functions of the core against scipy and closed forms.

tests/native/test_same_bits.py compares those of other processors.
"""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm

from netem.core.core_library import core, ffi
from noack.core.linear_systems import (
    Matrix,
    Propagator,
    balancing_exponents,
    exponential,
    norm,
    product,
    transition,
)


def square(n: int) -> st.SearchStrategy[Matrix]:
    return arrays(np.float64, (n, n), elements=st.floats(-1, 1))


generators = st.integers(1, 5).flatmap(square)


@given(generators, st.lists(st.integers(1, 10**9), min_size=1, max_size=5))
def test_cached_and_fresh_matrices_are_the_same_bits(A: Matrix, steps: list[int]) -> None:
    free, state = Propagator(A), np.ones(len(A))
    for dt_ns in [*steps, *reversed(steps)]:
        assert free.transition(dt_ns).tobytes() == transition(A, dt_ns).tobytes()
        assert free(state, dt_ns).tobytes() == Propagator(A)(state, dt_ns).tobytes()


@given(generators, st.lists(st.integers(0, 40), min_size=1, max_size=6), st.integers(1, 10**8))
def test_each_row_advances_by_its_own_number_of_periods(A: Matrix, counts: list[int], period_ns: int) -> None:
    states = np.random.default_rng(len(counts)).uniform(-1, 1, (len(counts), len(A)))
    advanced = Propagator(A).advance_by(states, np.array(counts) * period_ns, period_ns)
    expected = [expm(A * (j * period_ns * 1e-9)) @ x for j, x in zip(counts, states, strict=True)]
    # ‖A‖ ≤ 5 over at most 4 s: an error of 1e-13 of an entry grows by e^20.
    np.testing.assert_allclose(advanced, expected, rtol=1e-10, atol=1e-13 * np.exp(20))


@given(
    st.integers(2, 5).flatmap(lambda n: arrays(np.float64, (n, n), elements=st.floats(0.5, 2))),
    st.lists(st.integers(-40, 40), min_size=5, max_size=5),
)
def test_balancing_undoes_badly_chosen_units(similar: Matrix, units: list[int]) -> None:
    chosen = np.array(units[: len(similar)])
    given = np.ldexp(similar, chosen[:, None] - chosen)
    exponents = balancing_exponents(given)
    sizes = np.ldexp(given, exponents[:, None] - exponents)
    np.fill_diagonal(sizes, 0.0)  # no unit changes it
    # At the end no exponent moves by 1: a row's largest entry is at most twice its column's.
    ratios = sizes.max(axis=1) / sizes.max(axis=0)
    assert 0.5 <= ratios.min() <= ratios.max() <= 2


@given(st.integers(1, 12), st.integers(1, 12), st.integers(0, 2**32))
def test_a_product_rounds_each_term_and_then_each_sum_from_the_left(p: int, n: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    matrix, vector = random.standard_normal((p, n)), random.standard_normal(n)
    by_hand = []
    for row in matrix:
        # The nearest float of an exact value is the definition of rounding.
        terms = [float(Fraction(float(a)) * Fraction(float(b))) for a, b in zip(row, vector)]  # noqa: B905
        total = terms[0]
        for term in terms[1:]:
            total = float(Fraction(total) + Fraction(term))
        by_hand.append(total)
    assert product(matrix, vector).tolist() == by_hand


@given(st.floats(-1e6, 1e6))
def test_sine_and_cosine_are_those_of_numpy(turns: float) -> None:
    parts = ffi.new("double[2]")
    core.noack_sine_and_cosine(turns, parts)
    angle = 2 * np.pi * float(np.remainder(turns, 1.0))
    assert list(parts) == pytest.approx([np.sin(angle), np.cos(angle)], abs=1e-15)


@given(st.lists(st.floats(), min_size=1, max_size=20))
def test_a_norm_is_the_hypotenuse(values: list[float]) -> None:
    # About 20 roundings; numbers below 2⁻¹⁰²² have fewer digits.
    expected = math.hypot(*values)
    assert norm(np.array(values)) == pytest.approx(expected, rel=1e-14, abs=1e-320, nan_ok=True)


@pytest.mark.parametrize("n", [1, 2, 5, 14])
@pytest.mark.parametrize("scale", [0.0, 1e-9, 0.3, 0.95, 4.0, 60.0])
def test_the_exponential_is_that_of_scipy(n: int, scale: float) -> None:
    matrix = scale * np.random.default_rng(n).uniform(-1, 1, (n, n)) / np.sqrt(n)
    expected = expm(matrix)
    error = np.linalg.norm(exponential(matrix) - expected)
    assert error <= 1e-13 * max(scale, 1) * np.linalg.norm(expected)
