"""Slopes of a plant's equations: enclosed over a region, for the checker."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from flint import arb

from noack.plants.systems.traced_equations import trace


class _Function:
    """A plant ẋ = f(x + middle) − f(middle)."""

    def __init__(self, of: Callable[[Any], Any], middle: float) -> None:
        self.of, self.middle = of, middle

    def expressions(self, t_s: Any, x: Any, u: Any) -> Any:
        return [self.of(x[0] + self.middle) - float(self.of(self.middle)) + 0 * u[0]], x


def chord_slopes(of: Callable[[Any], Any], middle: float, radius: float) -> Any:
    """Return a ball of the slopes of a function's chords from the middle of an interval."""
    system: Any = _Function(of, middle)
    plants = trace(system, 1, 1, np.array([radius, 1.0]), signals=False).plants
    return plants.A[0, 0] + arb(0, plants.half_A[0, 0].abs_upper())


@pytest.mark.parametrize(
    "of",
    [
        np.sin, np.cos, np.tan, np.arctan, np.tanh, np.sinh, np.cosh, np.exp, np.log, np.sqrt,
        lambda x: x**3 - 2 / x + x**-1.5, lambda x: (1 - x * x) / (x + np.cos(x)),
        lambda x: np.abs(-x) + max(x, 0.0), lambda x: np.array([x, 2 * x]) @ np.array([3.0, x]),
        lambda x: np.clip(x, 0.7, 1.0) + np.maximum(x, 0.8) * np.minimum(x, 1.1),
        lambda x: x - np.clip(x, 0.7, 1.0), lambda x: np.sin(np.radians(60 * x)) * np.degrees(x),
        lambda x: np.sin(np.deg2rad(60 * x)) * np.rad2deg(x),
    ],
)  # fmt: skip
def test_slopes_of_chords_are_enclosed(of: Callable[[Any], Any]) -> None:
    middle, radius = 0.9, 0.3
    slopes = chord_slopes(of, middle, radius)
    points = np.linspace(middle - radius, middle + radius, 40)
    chords = [float(of(x) - of(middle)) / (x - middle) for x in points]
    assert all(slopes.lower() - 1e-9 <= chord <= slopes.upper() + 1e-9 for chord in chords)
    assert slopes.rad() < 2.5 * np.ptp(chords) + 0.01


@pytest.mark.parametrize(
    ("of", "slopes"), [(np.tanh, (0, 1)), (np.abs, (-1, 1)), (np.exp, (0, np.exp(40))), (np.arctan, (0, 1))]
)
def test_wide_intervals_have_enclosures(of: Callable[[Any], Any], slopes: tuple[float, float]) -> None:
    """Of an interval that is much wider than the range in which the function bends."""
    found = chord_slopes(of, 0.0, 40.0)
    assert found.abs_upper() <= 1.001 * slopes[1]
    assert found.lower() > slopes[0] - 0.01 * slopes[1]
