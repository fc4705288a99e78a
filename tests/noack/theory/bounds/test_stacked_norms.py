"""Products and norms of stacks, against numpy's of each matrix."""

import numpy as np
import pytest

from noack.theory.bounds.stacked_norms import (
    frobenius_norms_along_last,
    larger_ends,
    largest_eigenvalues,
    product_along_last,
    spectral_norms,
    stack_product,
)

DOUBLE_ROOT = 3e-8
"""Relative excess of the closed form for n = 3 where two singular values are nearly equal: √ε of an angle."""


@pytest.mark.parametrize("size", [1, 2, 3, 4])
@pytest.mark.parametrize("others", [1, 2, 3, 5])
def test_spectral_norms_are_the_largest_singular_values(size: int, others: int) -> None:
    """By closed forms up to three rows or columns, by eigenvalues beyond; also of 0 and huge entries."""
    rng = np.random.default_rng(size + 10 * others)
    stack = rng.normal(size=(50, size, others)) * 10.0 ** rng.integers(-140, 140, (50, 1, 1))
    stack[0], stack[1] = 0.0, 1e200
    assert spectral_norms(stack) == pytest.approx(np.linalg.norm(stack, 2, axis=(1, 2)), rel=1e-9, abs=0.0)


@pytest.mark.parametrize("split", [0.0, 1e-15, 1e-10, 1e-8, 1e-6, 1e-4])
@pytest.mark.parametrize("least", [0.0, 1e-3, 0.5, 0.999, 1.0])
def test_norms_with_nearly_equal_singular_values_are_not_too_small(split: float, least: float) -> None:
    rng = np.random.default_rng(0)
    U, V = (np.linalg.qr(rng.normal(size=(5000, 3, 3)))[0] for _ in range(2))
    singular = np.array([1.0, 1 - split, least * (1 - split)])
    norms = spectral_norms(U * singular @ V)
    assert norms.min() >= 1 - 1e-13  # of the products
    assert norms.max() <= 1 + DOUBLE_ROOT


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_largest_eigenvalues_are_those_of_gram_matrices(n: int) -> None:
    rows = np.random.default_rng(n).normal(size=(50, 4, n))
    grams = rows.swapaxes(1, 2) @ rows
    assert largest_eigenvalues(grams) == pytest.approx(np.linalg.eigvalsh(grams)[:, -1], rel=1e-9)


def test_products_are_those_of_each_matrix() -> None:
    rng = np.random.default_rng(0)
    matrix, stack = rng.normal(size=(2, 3)), rng.normal(size=(4, 5, 3, 2))
    expected = np.array([[matrix @ Y for Y in row] for row in stack])
    assert stack_product(matrix, stack) == pytest.approx(expected)
    along_last = product_along_last(matrix, np.moveaxis(stack, 1, -1))
    assert np.moveaxis(along_last, -1, 1) == pytest.approx(expected)
    sizes = frobenius_norms_along_last(np.moveaxis(stack, 1, -1))
    assert sizes == pytest.approx(np.linalg.norm(stack, axis=(2, 3)))


def test_the_larger_end_of_a_cell() -> None:
    assert larger_ends(np.array([[1.0, 3.0, 2.0]])).tolist() == [[3.0, 3.0]]
