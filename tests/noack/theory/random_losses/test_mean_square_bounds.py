"""Mean squares at every fixed time: inequalities iterated by hand, and simulated runs."""

from dataclasses import replace

import numpy as np
import pytest

from noack.theory.bounds.certificate_terms import NetworkConditions, NoCertificateError
from noack.theory.bounds.gains import ErrorGains, PlantGains
from noack.theory.random_losses.mean_square_bounds import root_mean_squares
from tests.noack.theory.certificates.certificate_kinds.random_losses import certify, draw, simulate_runs
from tests.noack.theory.random_losses.example_losses import scalar_loop


@pytest.mark.parametrize("p", [0.0, 0.01, 0.3, 0.9])
def test_root_mean_squares_of_a_scalar_loop_are_those_of_the_inequalities_iterated_by_hand(p: float) -> None:
    """π = g|e_c|, |x| = 1 + π/(r + e), |e_c| = β + lost errors, of which all add (e|x| + π)/r."""
    rate, gain, mismatch, beta = 2.0, 1.5, 0.2, 0.1
    plant = scalar_loop(rate, gain, mismatch)
    bounds = root_mean_squares(plant.error, plant, NetworkConditions(0), beta, p)
    e_c, powers = beta, p ** np.arange(1.0, 2000)
    for _ in range(2000):
        x = 1.0 + gain * e_c / (rate + mismatch)
        whole = (mismatch * x + gain * e_c) / rate
        tails = np.minimum(1, powers * whole / beta)
        burst = beta * np.sqrt(tails @ (2 * np.arange(len(tails)) + 1))
        e_c = beta + min(np.sqrt(p) * whole, burst)
    assert bounds.controller_error == pytest.approx(e_c, rel=0.02)
    assert bounds.state == pytest.approx(x, rel=0.02)
    assert bounds.input_error == pytest.approx(gain * e_c, rel=0.02)


@pytest.mark.parametrize(
    ("gain", "unit", "p", "conditions"),
    [
        (-1.5, 1.0, 0.3, NetworkConditions(0, delay_s=0.04)),
        (0.0, 1.0, 1.0, NetworkConditions(0)),
        (-1.5, 1e8, 0.3, NetworkConditions(0, 0.02, 0.02, 0.04, 0.04, 0.04)),
    ],
    ids=["events may be arbitrarily close", "all updates are lost", "no function is found"],
)
def test_root_mean_squares_without_a_quadratic_function_are_those_of_the_inequalities(
    gain: float, unit: float, p: float, conditions: NetworkConditions
) -> None:
    error = ErrorGains(-np.eye(1), np.array([[gain / unit]]), np.eye(1), 0.2)
    plant = PlantGains(error, np.array([[-1.2 - gain]]), np.array([[unit]]), np.array([[unit]]), 0.2)
    args = error, plant, conditions, 0.1 * unit, p
    refined_bounds, first_bounds = root_mean_squares(*args, refined=True), root_mean_squares(*args)
    assert refined_bounds.state <= first_bounds.state
    assert refined_bounds.controller_error <= first_bounds.controller_error


def test_inputs_that_are_too_old_for_the_fastest_mode_have_no_moments() -> None:
    """e^{−Hσ} overflows."""
    error = ErrorGains(-np.diag([1.0, 1e6]), np.array([[-0.1, -0.1]]), np.eye(2), 0.2)
    plant = PlantGains(error, -np.diag([1.0, 1e6]), np.zeros((2, 1)), np.ones((2, 1)), 0.2)
    with np.errstate(all="ignore"), pytest.raises(NoCertificateError, match="overflow"):
        root_mean_squares(error, plant, NetworkConditions(0, hold_s=0.007), 0.1, 0.3)


@pytest.mark.parametrize("seed", [5, 6, 12])
def test_moments_at_a_lower_rate_than_the_triggers(seed: int) -> None:
    """Random loops without moments at the trigger's rate, against their runs."""
    share, rng = 1e-3, np.random.default_rng(seed)
    loop = draw(rng, mismatch=0.5, alpha_share=0.8)
    assert certify(loop) is None
    bounds = certify(replace(loop, system=replace(loop.system, alpha=share * loop.system.alpha)))
    assert bounds is not None
    for name, worst in simulate_runs(loop, rng, share).worst.items():
        assert worst <= bounds[name], name
