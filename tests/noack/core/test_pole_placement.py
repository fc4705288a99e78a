"""Gains for given poles: those of textbooks, and repeated poles with one input."""

import numpy as np
import pytest

from noack.core.pole_placement import place_poles

COLUMN = np.eye(4)[:, -1:]


@pytest.mark.parametrize(
    ("n", "B", "poles", "expected"),
    [
        # The companion form: K is minus the coefficients of the polynomial; here (s + 2)² (s² + 2 s + 2).
        (4, COLUMN, [-2, -2, -1 + 1j, -1 - 1j], [[-8.0, -16.0, -14.0, -6.0]]),
        (4, COLUMN, [-1, -2, -3, -4], [[-24.0, -50.0, -35.0, -10.0]]),
        (2, [[0.0], [1.0]], [-2, -2], [[-4.0, -4.0]]),
        (2, [[0.0], [1.0]], [-1 + 1j, -1 - 1j], [[-2.0, -2.0]]),
        # Two inputs of one direction b vᵀ: of all gains the smallest, k v / |v|².
        (2, [[0.0, 0.0], [1.0, 3.0]], [-3, -3], [[-0.9, -0.6], [-2.7, -1.8]]),
    ],
)
def test_gains_of_the_companion_form(
    n: int, B: list[list[float]], poles: list[complex], expected: list[list[float]]
) -> None:
    found = place_poles(np.eye(n, k=1), np.array(B), np.array(poles, np.complex128))
    np.testing.assert_allclose(found, expected, rtol=1e-9)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_repeated_poles_of_random_systems(scale: float) -> None:
    """The closed loop's polynomial is the power of one factor, whatever the unit of time."""
    random = np.random.default_rng(4)
    for n in (2, 3, 4, 5):
        A, B = scale * random.normal(size=(n, n)), random.normal(size=(n, 1))
        poles = np.full(n, -2.0 * scale, np.complex128)
        closed = A + B @ place_poles(A, B, poles)
        coefficients, units = np.poly(closed), scale ** np.arange(n + 1.0)
        np.testing.assert_allclose(coefficients / units, np.poly(np.full(n, -2.0)), atol=1e-5 * 2.0**n)


def test_slow_samples_near_1_have_a_repeated_pole() -> None:
    A = np.eye(3) + 0.01 * np.eye(3, k=1)
    poles = np.full(3, np.exp(-0.05), np.complex128)
    closed = A + COLUMN[1:] @ place_poles(A, COLUMN[1:], poles)
    np.testing.assert_allclose(np.poly(closed), np.poly(poles.real), atol=1e-12)


@pytest.mark.parametrize(
    ("poles", "B", "message"),
    [
        ([-1, -2 + 1j], [[0.0], [1.0]], "conjugate pairs"),
        ([-1, -1, -1, -2], np.eye(4)[:, 2:], "more than 2 times \\(independent inputs"),
    ],
)
def test_poles_that_cannot_be_placed(poles: list[complex], B: list[list[float]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        place_poles(np.eye(len(poles), k=2), np.array(B), np.array(poles, np.complex128))
