"""Enclosures contain the exact results of rational arithmetic."""

from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from flint import arb_mat, fmpq

from noack.core.linear_systems import Matrix
from noack.theory.time_triggered.exact_matrices import IntervalMatrix, enclosing, exactly, inverse


def rational(matrix: Matrix) -> Any:
    return np.vectorize(Fraction, otypes=[object])(matrix)


def contains(enclosure: IntervalMatrix, exact: Any) -> bool:
    distance = abs(rational(enclosure.middle) - exact)
    return bool((distance <= rational(enclosure.radius)).all())


def matrix(rng: np.random.Generator, *shape: int) -> Matrix:
    return rng.normal(size=shape) * 10.0 ** rng.integers(-8, 9, shape)


@pytest.mark.parametrize("seed", range(10))
def test_products_and_differences_contain_the_exact_ones(seed: int) -> None:
    rng = np.random.default_rng(seed)
    A, B, C = matrix(rng, 3, 5), matrix(rng, 5, 4), matrix(rng, 3, 4)
    R = np.abs(matrix(rng, 3, 5)) * 1e-9
    end = rational(A) + rational(R) * rng.choice([-1, 1], R.shape)
    product = IntervalMatrix(A, R) @ exactly(B)
    assert contains(product, end @ rational(B))
    assert contains(product - exactly(C), end @ rational(B) - rational(C))
    sharp = exactly(A) @ exactly(B)
    assert contains(sharp, rational(A) @ rational(B))
    assert (sharp.radius <= 1e-14 * (np.abs(A) @ np.abs(B))).all()
    assert not contains(sharp._replace(radius=0 * sharp.radius), rational(A) @ rational(B))


@pytest.mark.parametrize("seed", range(11))
def test_inverse_contains_the_exact_one(seed: int) -> None:
    A = np.random.default_rng(seed).normal(size=(2, 2))
    if seed == 10:  # nearly singular
        A = np.array([[1.0, 2.0], [2.0, 4.0 + 1e-15]])
    (a, b), (c, d) = rational(A)
    inverse_A = inverse(A)
    assert inverse_A is not None
    assert contains(inverse_A, np.array([[d, -b], [-c, a]]) / (a * d - b * c))


def test_singular_matrices_have_no_inverse() -> None:
    assert inverse(np.array([[1.0, 2.0], [2.0, 4.0]])) is None


def test_a_matrix_of_balls_is_enclosed() -> None:
    shear = enclosing((arb_mat([[0, 3], [0, 0]]) * fmpq(5, 2)).exp())
    assert contains(shear, rational(np.array([[1.0, 7.5], [0.0, 1.0]])))
    assert shear.radius.max() < 1e-14
    # cos 1 and sin 1 to 50 digits (OEIS A049470, A049469)
    cos = Fraction("0.54030230586813971740093660744297660373231042061792")
    sin = Fraction("0.84147098480789650665250232163029899962256306079837")
    turn = enclosing(arb_mat([[0, 1], [-1, 0]]).exp())
    assert contains(turn, np.array([[cos, sin], [-sin, cos]]))
    assert turn.radius.max() < 1e-15
    with pytest.raises(OverflowError):
        enclosing(arb_mat([[1000]]).exp())
