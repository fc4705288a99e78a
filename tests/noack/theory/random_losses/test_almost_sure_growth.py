"""Growth in almost all runs: a closed form, simulated runs, units and rounding."""

from dataclasses import replace

import numpy as np
import pytest

from noack.impairments.loss_prediction import LossProcess, OutcomeChain
from noack.impairments.markov_chain import Array, NotPredictableError
from noack.theory.margins.exact_matrices import IntervalMatrix, exactly
from noack.theory.random_losses import almost_sure_growth as growth_module
from tests.noack.theory.random_losses.example_losses import BURSTY, independent, mean_square_growth, unlimited


def almost_sure_growth(delivered: Array, lost: Array, chain: OutcomeChain) -> float:
    return growth_module.almost_sure_growth(exactly(delivered), exactly(lost), chain)


@pytest.mark.parametrize("process", [independent(0.5), BURSTY], ids=["independent", "bursty"])
def test_almost_all_runs_of_a_scalar_grow_as_the_mean_of_the_logarithm(
    process: LossProcess,
) -> None:
    """Jensen's bound, the root of the mean square, is above 1; nevertheless runs decay."""
    delivered, lost = np.array([[0.2]]), np.array([[2.5]])
    chain = unlimited(process)
    share = float(chain.distribution() @ chain.lost.sum(axis=1))
    exact = 0.2 ** (1 - share) * 2.5**share
    assert almost_sure_growth(delivered, lost, chain) == pytest.approx(exact, rel=1e-6)
    assert exact < 1 < mean_square_growth([(delivered, lost)], chain)


@pytest.mark.parametrize("process", [independent(0.6), BURSTY], ids=["independent", "bursty"])
def test_almost_all_runs_of_random_loops_grow_at_most_by_the_bound(process: LossProcess) -> None:
    """40 runs of 2,000 periods, minus six standard errors; the bound is above by 4 % at most."""
    chain, slack, exceeded = unlimited(process), [], False
    fewer = unlimited(replace(process, lost=process.lost / 2))  # a broken copy
    for seed in (1, 5, 8, 9):  # the search for a bound takes long in others
        rng = np.random.default_rng(seed)
        delivered, lost = 0.7 * rng.normal(size=(2, 3, 3))
        maps, n = np.array([delivered, lost]), len(chain.lost)
        steps = np.cumsum(np.hstack([chain.delivered, chain.lost]), axis=1)
        z, state, grown = rng.normal(size=(40, 3)), np.full(40, n - 1), np.zeros(40)
        for _ in range(2000):
            step = (rng.uniform(size=(40, 1)) > steps[state]).sum(axis=1).clip(max=2 * n - 1)
            state = step % n
            z = np.einsum("kij,kj->ki", maps[step // n], z)
            size = np.linalg.norm(z, axis=1)
            grown, z = grown + np.log(size) / 2000, z / size[:, None]
        bound, error = np.log(almost_sure_growth(delivered, lost, chain)), grown.std() / np.sqrt(40)
        assert bound > grown.mean() - 6 * error
        assert bound <= np.log(mean_square_growth([(delivered, lost)], chain)) + 1e-6
        slack.append(bound - grown.mean())
        exceeded = exceeded or np.log(almost_sure_growth(delivered, lost, fewer)) < grown.mean() - 6 * error
    assert np.median(slack) < 0.04
    assert exceeded


def test_growth_does_not_depend_on_units_and_holds_for_fast_modes() -> None:
    """States in units that differ by 2^60, and maps with eigenvalues from 1e-9 to 1."""
    rng = np.random.default_rng(5)
    units, chain = np.ldexp(1.0, [0, 30, -30]), unlimited(independent(0.3))
    for fastest in (1.0, 1e-9):
        M0, M1 = (fastest * rng.normal(size=(3, 3)) + 0.5 * np.eye(3)[0] for _ in range(2))
        scaled = [units[:, None] * matrix / units for matrix in (M0, M1)]
        for growth, expected in (
            (mean_square_growth([(scaled[0], scaled[1])], chain),
             mean_square_growth([(M0, M1)], chain)),
            (almost_sure_growth(scaled[0], scaled[1], chain), almost_sure_growth(M0, M1, chain)),
        ):  # fmt: skip
            assert growth == pytest.approx(expected, rel=1e-5)
    with pytest.raises(NotPredictableError, match="beyond 1e308"):
        mean_square_growth([(np.eye(2), np.full((2, 2), np.inf))], chain)


def test_a_tilted_bound_contains_the_rounding_of_the_frequencies(monkeypatch: pytest.MonkeyPatch) -> None:
    """An inverse that is known to 1e-6 only makes the bound larger by as much times the weights."""
    delivered, lost, chain = np.array([[0.2]]), np.array([[2.5]]), unlimited(BURSTY)
    exact, inverse = almost_sure_growth(delivered, lost, chain), growth_module.inverse

    def inaccurate(matrix: Array) -> IntervalMatrix | None:
        enclosed = inverse(matrix)
        return enclosed and IntervalMatrix(enclosed.middle, enclosed.radius + 1e-6)

    monkeypatch.setattr(growth_module, "inverse", inaccurate)
    assert 1e-7 < almost_sure_growth(delivered, lost, chain) / exact - 1 < 1e-4
