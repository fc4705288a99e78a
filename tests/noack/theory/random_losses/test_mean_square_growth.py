"""Growth in mean square: closed forms, all patterns of losses, and refusals of wrong bounds."""

from itertools import product

import numpy as np
import pytest

from netem.impairments.loss_prediction import LossProcess, OutcomeChain
from netem.impairments.markov_chain import Array, NotPredictableError
from noack.theory.random_losses.mean_square_growth import PeriodMaps
from noack.theory.time_triggered.exact_matrices import IntervalMatrix
from tests.noack.theory.random_losses.example_losses import BURSTY, independent, mean_square_growth, unlimited


@pytest.mark.parametrize("p", [0.0, 0.2, 0.6, 1.0])
def test_a_scalar_grows_as_the_mean_of_its_squares(p: float) -> None:
    growth = mean_square_growth([(np.array([[0.5]]), np.array([[1.4]]))], unlimited(independent(p)))
    assert growth == pytest.approx(((1 - p) * 0.25 + p * 1.96) ** 0.5, rel=1e-6)


@pytest.mark.parametrize("process", [independent(0.4), BURSTY], ids=["independent", "bursty"])
def test_the_second_moment_of_all_patterns_grows_like_the_spectral_radius(
    process: LossProcess,
) -> None:
    """With two slots; the sum over all patterns of 14 periods, divided by that of 12."""
    rng = np.random.default_rng(3)
    slots = [(rng.normal(size=(2, 2)), rng.normal(size=(2, 2))) for _ in range(2)]
    fates = process.transitions * (1 - process.lost), process.transitions * process.lost

    def second_moment(periods: int) -> float:
        total = 0.0
        for pattern in product([0, 1], repeat=periods):
            weight: Array = process.start
            matrix = np.eye(2)
            for period, lost in enumerate(pattern):
                weight, matrix = weight @ fates[lost], slots[period % 2][lost] @ matrix
            total += float(weight.sum() * (matrix**2).sum())
        return total

    grown = (second_moment(12) / second_moment(10)) ** 0.25
    assert mean_square_growth(slots, unlimited(process)) == pytest.approx(grown, rel=0.01)


def test_a_spectral_radius_that_was_computed_too_small_is_not_accepted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    maps, chain = [(0.5 * np.eye(2), np.diag([1.4, 0.3]))], unlimited(BURSTY)
    assert mean_square_growth(maps, chain) > 0
    values = np.linalg.eigvals
    monkeypatch.setattr(np.linalg, "eigvals", lambda matrix: 0.999 * values(matrix))
    with pytest.raises(NotPredictableError, match="bounded numerically"):
        mean_square_growth(maps, chain)


@pytest.mark.parametrize("radius", [0.0, 1e-9])
def test_a_bound_of_the_second_moments_is_proven_with_all_rounding(radius: float) -> None:
    """x becomes ax with |a| ≤ 0.7 + radius, and has another state that nothing moves."""
    size, chain = 0.7 + radius, OutcomeChain(np.array([[0.4]]), np.array([[0.6]]))
    M = IntervalMatrix(np.diag([0.7, 0.0]), np.diag([radius, 1e-16]))
    maps = PeriodMaps([(np.array([[0.7]]), np.array([[0.7]]))], [(M, M)])
    forms = np.ones((len(chain.lost), 1, 1))
    assert maps.is_below(size**2 * (1 + 1e-12), forms, chain)
    assert not maps.is_below(size**2 * (1 - 1e-15), forms, chain)
