"""The gains of a box of plants, against the exact bounds of a scalar plant."""

import numpy as np
import pytest

from noack.theory.bounds.box import BoxGains
from noack.theory.bounds.certificate_terms import Constants, NetworkConditions, TriggerBound
from noack.theory.bounds.enclosure import NotDecayingError
from noack.theory.bounds.gains import ErrorGains, Forcing
from noack.theory.certificates.solution import solve


@pytest.mark.parametrize("alpha", [0.1, 1.0])
@pytest.mark.parametrize("share_of_A", [0.0, 0.3, 1.0])
def test_a_scalar_box_is_as_large_as_it_can_be(alpha: float, share_of_A: float) -> None:
    """ẋ = (a + bk)x + bp with rate λ: certified while the worst corner, λ − |ã| − |b̃k|, exceeds α.

    There, x is bounded by x₀ and |b|π over the worst rate's margin, exactly.
    """
    rate, k, beta, x0 = 2.0, -3.0, 0.1, 0.7
    unit, whole = np.eye(1), rate - alpha
    models = ErrorGains(-rate * unit, k * unit, unit, alpha)

    def certified(size: float, half_A: float, half_B: float) -> Constants:
        halves = size * half_A * unit, size * half_B * unit
        plant = BoxGains(models, unit, unit, x0 * unit, alpha, *halves)
        return solve(models, plant, NetworkConditions(2), TriggerBound(beta, beta))

    half_A, half_B = whole * share_of_A, whole * (1 - share_of_A) / -k
    with pytest.raises(NotDecayingError, match="differ too much from the model"):
        certified(1.005, half_A, half_B)
    for size in (0.1, 0.5, 0.95):
        constants = certified(size, half_A, half_B)
        state, p, margin = constants.state, constants.input_error, whole * (1 - size)
        forced = (1.0 + size * half_B) * p
        start = x0 * whole / margin  # bound for a state that does not decay
        # The enclosures' 0.5 %, and the separate bounds of start and input error.
        assert state == pytest.approx(start + forced / margin, rel=0.15)
        assert state >= (start + forced / margin) * (1 - 1e-9)
        # w of the state and of the corresponding input.
        w = size * (half_A * state + half_B * (-k * state + p))
        assert constants.mismatch == pytest.approx(w, rel=1e-3)


@pytest.mark.parametrize("start_s", [0.1, 1.0, 5.0])
def test_before_the_first_input_a_disturbance_of_the_input_enters_through_the_whole_of_b(
    start_s: float,
) -> None:
    """An integrator with b up to 1.5 and a disturbance of 1 is at 1.5 t before its first input."""
    unit = np.eye(1)
    forcing = Forcing(unit, np.array([np.inf]), np.ones(1))
    zero, models = 0 * unit, ErrorGains(-unit, -unit, unit, 0.0)
    plant = BoxGains(models, zero, unit, zero, 0.0, zero, 0.5 * unit, forcing=forcing)
    input_error, _ = plant.start_up(start_s)
    assert float(input_error) >= 1.5 * start_s
