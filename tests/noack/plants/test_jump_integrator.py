"""The integrator that locates jumps, run as Python code, against closed forms."""

import math
from typing import Any

import numpy as np
import pytest

from noack.plants.systems import jump_integrator
from noack.plants.systems.jump_integrator import DONE, advance, buffers

TOLERANCES = 1e-6, 1e-9


class Switched:
    """dz/dt under the sign of z[0]; counts its evaluations."""

    def __init__(self, slope_at: Any) -> None:
        self.slope_at = slope_at
        self.evaluations = 0

    def __call__(
        self, model: Any, z: Any, v: Any, parameters: Any, signs: Any, values: Any, slope: Any
    ) -> None:
        self.evaluations += 1
        values[0] = z[0]
        slope[:] = self.slope_at(z, signs[0] or np.sign(z[0]))


def advanced(rates: Switched, z0: list[float], duration_s: float) -> tuple[int, np.ndarray]:
    z = np.array(z0)
    code = advance(rates, None, z, np.zeros(0), None, duration_s, TOLERANCES, buffers(len(z), 1))
    return code, z


def accelerated_to_the_middle(t_s: float) -> list[float]:
    """x and dx/dt of ẍ = −sign(x) from (1, 0): parabolas, a zero every 2√2 s after √2 s."""
    quarter = math.sqrt(2.0)
    half, within_s = divmod(t_s + quarter, 2 * quarter)
    side = 1.0 if half % 2 == 0 else -1.0
    return [side * within_s * (2 * quarter - within_s) / 2, side * (quarter - within_s)]


@pytest.mark.parametrize("duration_s", [1.0, 2.0, 7.0, 15.0])
def test_parabolas_between_jumps_are_exact(duration_s: float) -> None:
    rates = Switched(lambda z, sign: [z[1], -sign])
    code, z = advanced(rates, [1.0, 0.0], duration_s)
    assert code == DONE
    np.testing.assert_allclose(z, accelerated_to_the_middle(duration_s), atol=1e-5)
    jumps = (duration_s / math.sqrt(2.0) + 1) // 2
    assert rates.evaluations <= 60 + 60 * jumps  # a step without a jump takes six or seven


def test_endless_changes_of_a_sign_end_the_integration(monkeypatch: pytest.MonkeyPatch) -> None:
    """z slides along the jump: no sign can be held, and an error control cannot pass."""
    monkeypatch.setattr(jump_integrator, "_MAX_STEPS", 1000)
    rates = Switched(lambda z, sign: [0.2 - sign])
    code, z = advanced(rates, [0.5], 2.0)
    assert code < 0
    assert abs(z[0]) < 1e-3
    assert rates.evaluations < 20_000


def test_equations_that_are_not_finite_are_a_failure() -> None:
    code, _ = advanced(Switched(lambda z, sign: [math.nan]), [1.0], 1.0)
    assert code == jump_integrator.TOO_SMALL_STEPS
