"""The barrier method against optima in closed form, and its margin for rounding."""

import numpy as np
import pytest
from scipy.linalg import eigh

from noack.core.linear_systems import Matrix, Vector
from noack.theory.random_losses.matrix_inequalities import Blocks, MatrixInequalities, is_positive

NEARLY_LARGEST = 0.98
"""The value that is found is at least this share of the largest one."""


def positive_matrix(rng: np.random.Generator, n: int) -> Matrix:
    root = rng.normal(size=(n, 2 * n))
    return root @ root.T


def largest_multiple(A: Matrix, B: Matrix, first: float) -> float:
    """The largest λ that is found with A − λB ≻ 0."""

    def blocks(values: Vector) -> Blocks:
        return np.zeros(0), A - values[0] * B

    solution = MatrixInequalities(blocks, 1).maximise_last(np.array([first]))
    assert solution is not None
    return float(solution[0])


@pytest.mark.parametrize("seed", range(5))
def test_the_largest_multiple_is_the_smallest_generalized_eigenvalue(seed: int) -> None:
    rng = np.random.default_rng(seed)
    A, B = positive_matrix(rng, 4), positive_matrix(rng, 4)
    exact = eigh(A, B, eigvals_only=True)[0]
    assert NEARLY_LARGEST * exact <= largest_multiple(A, B, 1e-3 * exact) < exact


def test_coordinates_do_not_change_what_is_found() -> None:
    """Newton's steps are the same in all of them; units that are further apart are refused for rounding."""
    rng = np.random.default_rng(1)
    A, B = positive_matrix(rng, 4), positive_matrix(rng, 4)
    T = rng.normal(size=(4, 4)) * np.geomspace(1e-2, 1e2, 4)
    first = 1e-3 * eigh(A, B, eigvals_only=True)[0]
    assert largest_multiple(T.T @ A @ T, T.T @ B @ T, first) == pytest.approx(
        largest_multiple(A, B, first), rel=1e-6
    )


@pytest.mark.parametrize("seed", range(3))
def test_a_block_matrix_is_positive_up_to_the_inverse_of_a_norm(seed: int) -> None:
    """(I, tM; tMᵀ, I) ≻ 0 exactly if t‖M‖ < 1."""
    M = np.random.default_rng(seed).normal(size=(3, 3))
    zero = np.zeros((3, 3))
    exact = 1 / float(np.linalg.norm(M, 2))
    multiple = largest_multiple(np.eye(6), -np.block([[zero, M], [M.T, zero]]), 1e-3 * exact)
    assert NEARLY_LARGEST * exact <= multiple < exact


def test_numbers_divide_a_sum_in_the_best_way() -> None:
    """The largest t with x_i > c_i t and Σ x_i < 1 is 1/Σ c_i; it is found in any units of x."""
    costs = np.array([1.0, 2.0, 5.0])

    def found_in(units: Vector) -> Vector:
        def blocks(values: Vector) -> Blocks:
            x, t = values[:3] * units, values[3]
            return np.array([1 - x.sum(), *(x - costs * t)]), np.eye(1)

        first = np.append(np.full(3, 0.2) / units, 1e-3)
        solution = MatrixInequalities(blocks, 4).maximise_last(first)
        assert solution is not None
        return solution

    alone, scaled = found_in(np.ones(3)), found_in(np.array([1e-3, 1.0, 1e5]))
    assert NEARLY_LARGEST / costs.sum() <= alone[3] < 1 / costs.sum()
    assert scaled[3] == pytest.approx(alone[3], rel=1e-6)
    assert alone[:3].sum() < 1
    assert (alone[:3] > costs * alone[3]).all()


def test_a_matrix_of_unknowns_divides_a_trace_in_the_best_way() -> None:
    """The largest t with X ≻ tC and tr X < 1 is 1/tr C."""
    C = positive_matrix(np.random.default_rng(2), 3)
    rows, columns = np.tril_indices(3)

    def blocks(values: Vector) -> Blocks:
        X = np.zeros((3, 3))
        X[rows, columns] = X[columns, rows] = values[:6]
        return np.array([1 - np.trace(X)]), X - values[6] * C

    first = np.append(0.2 * np.eye(3)[rows, columns], 1e-3 / np.trace(C))
    solution = MatrixInequalities(blocks, 7).maximise_last(first)
    assert solution is not None
    assert NEARLY_LARGEST / np.trace(C) <= solution[6] < 1 / np.trace(C)


@pytest.mark.parametrize(("distance", "is_confirmed"), [(1e-15, False), (1e-11, True)])
def test_a_matrix_that_is_positive_by_rounding_alone_is_not_confirmed(
    distance: float, is_confirmed: bool
) -> None:
    nearly_singular = np.array([[1.0, 1 - distance], [1 - distance, 1.0]])
    assert is_positive(nearly_singular)

    def blocks(values: Vector) -> Blocks:
        return np.array([1 - values[0]]), nearly_singular

    solution = MatrixInequalities(blocks, 1).maximise_last(np.array([0.5]))
    assert (solution is not None) is is_confirmed


@pytest.mark.parametrize(
    ("block", "expected"),
    [
        (np.array([1.0, 1e-300]), True),
        (np.array([1.0, 0.0]), False),
        (np.array([[2.0, 1.0], [1.0, 1.0]]), True),
        (np.array([[1.0, 1.0], [1.0, 1.0]]), False),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), False),
    ],
)
def test_positive_means_above_0_or_positive_definite(block: Matrix, expected: bool) -> None:
    assert is_positive(block) is expected
