"""Moments under random losses: closed forms, Monte Carlo at events, and decay of every run."""

import numpy as np
import pytest

from cosim.simulation.continuous import ContinuousLoop, simulate_continuous
from noack.impairments.loss_prediction import LossProcess
from noack.theory.bounds.gains import ErrorGains, PlantGains
from noack.theory.bounds.terms import NetworkConditions, NoCertificateError
from noack.theory.random_losses.moments import moment_at_events, moments
from tests.noack.theory.exact_loops import loop_of
from tests.oracles.lossy_loops import System, random_system
from tests.trigger_rules import decaying_rule

EVENTS = 12


def independent(p: float) -> LossProcess:
    return LossProcess(np.ones(1), np.ones((1, 1)), np.array([p]))


def scalar(rate: float, gain: float, mismatch: float) -> PlantGains:
    """x' = −(rate + mismatch) x + p, a model that decays at ``rate``, and u = −gain x_c."""
    one = np.eye(1)
    error = ErrorGains(-rate * one, -gain * one, one, 0.0)
    return PlantGains(error, (gain - rate - mismatch) * one, one, one, 0.0)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("p", [0.1, 0.5, 0.9])
def test_in_a_contracting_norm_the_moment_at_events_is_the_geometric_series(
    p: float, order: int
) -> None:
    error = scalar(2.0, 3.0, 0.0).error
    found = moment_at_events(error, independent(p), 0.0, order)
    assert found == pytest.approx(1 / (1 - p ** (1 / order)), rel=1e-6)
    assert moment_at_events(error, independent(p), 0.5, order) < found


def test_moments_of_a_scalar_loop_are_those_of_the_inequalities_solved_by_hand() -> None:
    """a = β, m = e|x|; π = g|e_c|, |e_c| = β + p (m + π)/r, |x| = 1 + π/(r + e)."""
    rate, gain, mismatch, beta, p = 2.0, 1.5, 0.2, 0.1, 0.2
    plant = scalar(rate, gain, mismatch)
    found = moments(plant.error, plant, NetworkConditions(0), beta, p, 1)
    matrix = np.array([[1.0, -p * mismatch / rate, -p * gain / rate],
                       [0.0, 1.0, -gain / (rate + mismatch)],
                       [-1.0, 0.0, 1.0]])  # e_c, x, e_c again as π/g  # fmt: skip
    e_c, x, _ = np.linalg.solve(matrix, [beta, 1.0, 0.0])
    assert found.controller_error == pytest.approx(e_c, rel=0.02)
    assert found.state == pytest.approx(x, rel=0.02)
    assert found.input_error == pytest.approx(gain * e_c, rel=0.02)


def test_too_many_losses_have_no_moments() -> None:
    plant = scalar(1.0, 3.0, 0.5)
    with pytest.raises(NoCertificateError):
        moments(plant.error, plant, NetworkConditions(0), 0.1, 0.9, 1)


@pytest.mark.parametrize("seed", [1, 2])
def test_the_mean_at_events_is_below_its_bound_and_above_it_with_fewer_losses(seed: int) -> None:
    """In exact continuous time; the loops differ, and so do their runs' events."""
    rng, p = np.random.default_rng(seed), 0.6
    system = random_system(rng, mismatch=0.5, beta=0.01, known_start=False, spread=1.0)
    sums, squares = np.zeros(EVENTS), np.zeros(EVENTS)
    loop, runs = loop_of(system), 150
    trigger = decaying_rule(system.beta, system.alpha, weight=loop.weight, n=loop.n)
    continuous = ContinuousLoop(loop, trigger)
    for _ in range(runs):
        sizes = scaled_errors(system, continuous, rng.uniform(size=EVENTS + 1) < p)
        sums[: len(sizes)] += sizes
        squares[: len(sizes)] += sizes**2
    mean = sums / runs
    least = mean - 5 * np.sqrt(np.maximum(squares / runs - mean**2, 0.0) / runs)
    error = system.gains().error
    assert least.max() <= moment_at_events(error, independent(p), 0.0, 1)
    assert mean.max() > moment_at_events(error, independent(0.0), 0.0, 1)


def scaled_errors(system: System, loop: ContinuousLoop, lost: np.ndarray) -> np.ndarray:
    """‖e_c‖_W e^{αt}/β just before the events after the first one."""
    horizon_s = 4 / float(np.abs(np.linalg.eigvals(system.A + system.B @ system.K)).max())
    run = simulate_continuous(
        loop,
        horizon_s=horizon_s,
        delivered=lambda event: event == 0 or event >= len(lost) or not lost[event],
        known_start=False,
    )
    return np.array([
        np.linalg.norm(system.weight @ one.e_c) * np.exp(system.alpha * one.t_s) / system.beta
        for one in run.before[1:EVENTS]
    ])  # fmt: skip
