"""Nelder and Mead's search on functions whose minimum is known."""

import numpy as np
import pytest

from cosim.studies.design.simplex_search import nelder_mead, step_sizes
from noack.core.linear_systems import Vector

MINIMUM = np.array([0.7, -0.4])


def test_the_first_point_below_the_limit_is_returned() -> None:
    values: list[float] = []

    def objective(point: Vector) -> float:
        values.append(float(np.sum((point - MINIMUM) ** 2 * [1.0, 10.0])))
        return values[-1]

    point = nelder_mead(objective, 2, 0.1, evaluations=500, enough=1e-3)
    assert point is not None
    np.testing.assert_allclose(point, MINIMUM, atol=0.04)
    assert values[-1] < 1e-3 <= min(values[:-1])


def test_without_a_point_below_the_limit_the_evaluations_are_limited() -> None:
    points: list[Vector] = []

    def objective(point: Vector) -> float:
        points.append(point.copy())
        return float(np.sum((point - MINIMUM) ** 2))

    assert nelder_mead(objective, 2, 0.1, evaluations=60, tolerance=0.0, enough=-1.0) is None
    assert len(points) <= 60
    np.testing.assert_allclose(
        min(points, key=lambda point: np.sum((point - MINIMUM) ** 2)), MINIMUM, atol=0.01
    )


def test_a_small_entry_of_a_gain_has_a_tenth_of_its_rows_largest_step() -> None:
    assert step_sizes(np.array([[-2.0, 0.01], [0.3, 1.0]])) == pytest.approx([2.0, 0.2, 0.3, 1.0])
