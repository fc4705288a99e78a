import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from noack.core.ordered_arithmetic import multiply, norm_of, product

floats = st.floats(allow_subnormal=True, width=64)


@given(st.integers(1, 12), st.integers(1, 12), st.integers(0, 2**32))
def test_a_product_rounds_each_term_and_then_each_sum_from_the_left(
    p: int, n: int, seed: int
) -> None:
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
    result = np.zeros(p)
    multiply(matrix.ravel(), 0, vector, 0, result, 0, (p, n))
    assert result.tolist() == by_hand


@pytest.mark.parametrize("n", [3, 30])
def test_a_product_of_a_diverged_state_needs_no_warning(n: int) -> None:
    matrix = np.zeros((n, n))
    matrix[0, 0], vector = 1e300, np.full(n, math.inf)
    vector[1] = 1e300
    assert np.isnan(product(matrix, vector)).all()


def test_a_negative_zero_stays() -> None:
    for n in (1, 30):
        found = product(np.full((1, n), -1.0), np.zeros(n))
        assert math.copysign(1.0, found.item()) == -1.0


@given(st.lists(floats, min_size=1, max_size=20))
def test_a_norm_is_the_hypotenuse(values: list[float]) -> None:
    expected = math.hypot(*values)
    found = norm_of([7.0, *values], 1, len(values))
    # About 20 roundings; numbers below 2⁻¹⁰²² have fewer digits.
    assert found == pytest.approx(expected, rel=1e-14, abs=1e-320, nan_ok=True)
