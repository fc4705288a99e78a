"""Outputs over intersections of ellipsoids: a closed form, and random points that are in all of them."""

import numpy as np
import pytest

from noack.theory.certificates.deliveries.ellipsoid_intersections import Wanted, bound_outputs

CROSSED = np.array([np.diag([1.0, 0.01]), np.diag([0.01, 1.0])])
"""Two ellipses that are long in different directions: their intersection is nearly a square."""


@pytest.mark.parametrize(
    ("direction", "largest"),
    [((1.0, 0.0), 1.0), ((0.0, 1.0), 1.0), ((1.0, 1.0), 2 / np.sqrt(1.01))],  # by hand; the last at z₁ = z₂
)
def test_the_bound_is_the_largest_output_of_two_crossed_ellipses(
    direction: tuple[float, float], largest: float
) -> None:
    bounds, _ = bound_outputs(CROSSED[None], np.array([[direction]]), 0.0)
    assert largest <= bounds[0] <= (1 + 1e-4) * largest


@pytest.mark.parametrize("wanted", Wanted)
def test_no_point_of_an_intersection_exceeds_its_bound(wanted: Wanted) -> None:
    rng = np.random.default_rng(1)
    rows = rng.normal(size=(5, 6, 2, 4))
    forms, Y = rows.swapaxes(-1, -2) @ rows, rng.normal(size=(5, 3, 4))
    bounds, weights = bound_outputs(forms, Y, 0.0, wanted=wanted)
    z = rng.normal(size=(2000, 5, 4))
    z /= np.sqrt(np.einsum("kja,jiab,kjb->kji", z, forms, z).max(axis=-1))[..., None]
    outputs = np.linalg.norm(np.einsum("jqa,kja->kjq", Y, z), axis=-1).max(axis=0)
    assert (outputs <= bounds).all()
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    by_equal_weights, _ = bound_outputs(forms, Y, np.inf)  # any bound is enough
    assert (bounds <= by_equal_weights).all()
    if wanted is Wanted.ALL:
        assert (bounds < 0.95 * by_equal_weights).all()


def test_forms_that_leave_a_direction_free_bound_nothing() -> None:
    flat = np.diag([1.0, 1e-12])
    bounds, _ = bound_outputs(np.array([[flat, 2 * flat]]), np.array([[[0.0, 1.0]]]), 0.0)
    assert np.isinf(bounds[0])
