"""What one gap makes of x: its times by hand, and no gain is exceeded by an exact simulation."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from scipy.linalg import expm

from noack.core.linear_systems import Matrix, Vector
from noack.theory.bounds.certificate_terms import (
    InterEventTimes,
    NetworkConditions,
    NoCertificateError,
    TriggerBound,
)
from noack.theory.bounds.gains import ErrorGains, PlantGains
from noack.theory.certificates.deliveries.delivery_gaps import GapLoop, Gaps

A, B, K = np.array([[0.0, 1.0], [-1.0, 0.4]]), np.array([[0.0], [1.0]]), np.array([[-1.0, -2.0]])
H = np.array([[-0.3, 0.8], [-1.9, -1.5]])
ALPHA, STEP_S, HOLD_S = 0.1, 0.1, 0.03


def loop_with(hold_s: float, dropouts: int = 1) -> GapLoop:
    """A loop with two states whose events are due at 0.1 s; its model is not its plant."""
    conditions = NetworkConditions(dropouts, STEP_S, STEP_S, hold_s=hold_s)
    bound = TriggerBound(0.0, None, times=InterEventTimes(STEP_S, STEP_S))
    models = ErrorGains(H, K, np.eye(2), ALPHA)
    plant = PlantGains(models, A, B, np.array([[1.0], [0.0]]), ALPHA)
    return GapLoop(plant, conditions, Gaps.of(conditions, bound))


@pytest.mark.parametrize(
    ("shortest_s", "longest_s", "steps"),
    [
        (0.1, 0.1, [1, 2, 3]),  # one event after the other, of which up to two are lost
        (0.2, 0.3, [2, 3, 4, 5, 6, 7, 8, 9]),
        (0.3, 0.4, [3, 4, 6, 7, 8, 9, 10, 11, 12]),  # no sum of 3 and 4 is 5
    ],
)
def test_a_gap_is_a_sum_of_the_times_between_events(
    shortest_s: float, longest_s: float, steps: Sequence[int]
) -> None:
    conditions = NetworkConditions(2, 0.1, 0.1)
    gaps = Gaps.of(conditions, TriggerBound(0.0, None, times=InterEventTimes(shortest_s, longest_s)))
    assert gaps.counts.tolist() == steps
    assert gaps.step_s == pytest.approx(0.1)
    assert gaps.least_s == pytest.approx(shortest_s)


@pytest.mark.parametrize(("spacing_s", "longest_s"), [(0.0, 1.0), (0.1, math.inf), (0.001, 1.0)])
def test_events_that_are_not_due_at_few_times_have_no_gaps(spacing_s: float, longest_s: float) -> None:
    with pytest.raises(NoCertificateError):
        Gaps.of(
            NetworkConditions(1, spacing_s, spacing_s),
            TriggerBound(0.0, None, times=InterEventTimes(longest_s=longest_s)),
        )


def scaled_after(gap_s: float, xi: Vector, ages_s: Sequence[float]) -> tuple[Vector, Vector]:
    """x and e_c after a gap from ξ, times e^{αg}; the age of the input is constant in equal parts."""
    z, part_s = np.append(xi, xi), gap_s / len(ages_s)
    for age_s in ages_s:
        aged_input = B @ K @ expm(-H * age_s)
        z = expm(np.block([[A, aged_input], [np.zeros((2, 2)), H]]) * part_s) @ z
    scaled = math.exp(ALPHA * gap_s) * z
    return scaled[:2], scaled[2:] - scaled[:2]


def test_without_ages_the_gains_are_the_norms_of_the_matrices_by_which_a_gap_multiplies() -> None:
    loop, scaling = loop_with(0.0), np.array([[1.2, 0.3], [0.0, 0.7]])
    gains = loop.gains(scaling)
    for number, gap_s in enumerate((STEP_S, 2 * STEP_S)):
        columns = [scaled_after(gap_s, xi, [0.0]) for xi in np.linalg.inv(scaling).T]
        states, errors = (np.array(part).T for part in zip(*columns, strict=True))
        assert gains.state_from_state[number] == pytest.approx(np.linalg.norm(scaling @ states, 2))
        assert gains.late_effect_from_state[number] == pytest.approx(np.linalg.norm(K @ errors, 2))


def test_no_age_of_the_input_exceeds_the_gains_and_the_worst_one_comes_close() -> None:
    loop, scaling = loop_with(HOLD_S), np.array([[1.2, 0.3], [0.0, 0.7]])
    gains, inverse = loop.gains(scaling), np.linalg.inv(scaling)
    rng = np.random.default_rng(1)
    patterns: list[Matrix] = [np.full(8, HOLD_S), np.full(8, -HOLD_S)]
    patterns += [*rng.uniform(-HOLD_S, HOLD_S, (30, 8)), *rng.choice([-HOLD_S, HOLD_S], (30, 8))]
    for number, gap_s in enumerate((STEP_S, 2 * STEP_S)):
        largest = 0.0
        for ages_s in patterns:
            states = np.array([scaled_after(gap_s, xi, ages_s)[0] for xi in inverse.T]).T
            largest = max(largest, float(np.linalg.norm(scaling @ states, 2)))
        assert largest <= gains.state_from_state[number] <= 1.01 * largest
