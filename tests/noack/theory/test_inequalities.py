"""Linear inequalities, and the effect of all lost updates, against random admissible losses.

Every lost update is lost for ever here, and its error has the worst direction.
"""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from noack.core.linear_systems import Matrix
from noack.impairments.loss_guarantee import LongestBurst, LossesInWindow, LossWindow
from noack.theory.bounds.gains import ErrorGains, Output, PlantGains
from noack.theory.bounds.terms import NetworkConditions, TriggerBound
from noack.theory.certificates.inequalities import solve_inequalities
from noack.theory.certificates.loss_accumulation import LossAccumulation
from noack.theory.certificates.solution import solve
from tests.oracles.lossy_loops import SEARCH, System, systems


def exact_solution(F: np.ndarray, g: np.ndarray) -> list[Fraction]:
    size = len(g)
    rows = [
        [Fraction(int(i == j)) - Fraction(float(F[i, j])) for j in range(size)]
        + [Fraction(float(g[i]))]
        for i in range(size)
    ]
    for k in range(size):
        rows[k] = [value / rows[k][k] for value in rows[k]]
        for i in range(size):
            if i != k:
                rows[i] = [a - rows[i][k] * b for a, b in zip(rows[i], rows[k], strict=True)]
    return [row[-1] for row in rows]


@pytest.mark.parametrize("size", [1, 2, 3, 5])
@pytest.mark.parametrize("radius", [0.3, 0.99, 1 - 1e-9])
def test_the_bound_is_above_the_exact_solution_and_close_to_it(size: int, radius: float) -> None:
    rng = np.random.default_rng([size, int(1e9 * radius)])
    for _ in range(50):
        F = rng.uniform(size=(size, size)) * (rng.uniform(size=(size, size)) < 0.8)
        F *= radius / max(np.abs(np.linalg.eigvals(F)).max(), 0.1)
        g = rng.uniform(size=size)
        unused = rng.integers(size + 1)
        F[unused : unused + 1], g[unused : unused + 1] = 0.0, 0.0
        scale = 10.0 ** (rng.integers(-150, 150) + rng.integers(-2, 3, size))
        F, g = F * (scale[:, None] / scale), g * scale
        found = solve_inequalities(F, g)
        assert np.isfinite(found.bound).all()
        assert found.loop_gain < 1
        for bound, exact in zip(found.bound, exact_solution(F, g), strict=True):
            assert Fraction(float(bound)) >= exact
            assert float(bound) <= float(exact) * (1 + 1e-10 / (1 - radius))


def test_a_spectral_radius_of_1_or_more_has_no_bound() -> None:
    rng = np.random.default_rng(0)
    for size in (1, 2, 3, 5):
        F = rng.uniform(size=(size, size))
        F /= np.abs(np.linalg.eigvals(F)).max()
        for radius in (1 + 1e-12, 1.5, 40.0):
            found = solve_inequalities(radius * F, np.ones(size))
            assert np.isinf(found.bound).all()
            assert found.loop_gain >= 1 - 1e-9
    assert np.isinf(solve_inequalities(np.full((2, 2), np.nan), np.ones(2)).bound).all()


EVENTS = 120
ROUNDING = 1 + 1e-9


def effects(plant: PlantGains, output: Output, delay_s: float, ages_s: np.ndarray) -> list[Matrix]:
    """C ∫_d^τ e^{(A+BK+αI)(τ−s)} B K e^{(H+αI)s} W⁻¹ ds for each age τ."""
    error, n = plant.error, len(plant.A)
    flow = np.zeros((2 * n, 2 * n))
    flow[:n, :n], flow[:n, n:], flow[n:, n:] = plant.closed_loop, plant.B @ error.K, error.scaled_H
    C, first = plant.outputs[output], expm(error.scaled_H * delay_s) @ error.inverse_weight
    later = [expm(flow * max(age_s - delay_s, 0.0))[:n, n:] for age_s in ages_s.tolist()]
    return [C @ one @ first for one in later]


def worst_sum(found: list[Matrix]) -> float:
    """The largest ‖Σ M_j v_j‖ over unit vectors v_j, from below: in the largest M's direction."""
    if not found:
        return 0.0
    u = np.linalg.svd(max(found, key=lambda one: float(np.linalg.norm(one, 2))))[0][:, 0]
    return float(sum(np.linalg.norm(one.T @ u) for one in found))


def lost_ages_s(seed: int, spacing_s: float, window: LossWindow) -> np.ndarray:
    """Ages of lost events, at least ``spacing_s`` apart, newest first."""
    rng = np.random.default_rng(seed)
    gaps = 1 + rng.exponential(rng.choice([0.0, 0.3, 3.0]), EVENTS)
    wanted = rng.uniform(size=EVENTS) < rng.choice([0.3, 0.7, 1.0])
    lost = np.zeros(EVENTS, dtype=bool)
    for i in range(EVENTS):
        recent = lost[max(i - window.packets + 1, 0) : i].sum()
        lost[i] = wanted[i] and recent < window.losses
    return (rng.uniform(0, 3) * spacing_s + np.cumsum(gaps) * spacing_s)[lost]


windows = st.sampled_from([LossWindow(*one) for one in [(1, 2), (2, 3), (1, 6), (3, 10), (5, 6)]])
shares = st.sampled_from([0.05, 0.3, 1.0])


def spacing_of(system: System, share: float) -> float:
    return share / float(np.abs(np.linalg.eigvals(system.H)).max())


@settings(SEARCH, max_examples=25)
@given(systems(), windows, shares, st.sampled_from([0.0, 0.4, 2.5]), st.integers(0, 2**32))
def test_no_admissible_losses_have_a_larger_effect(
    system: System, window: LossWindow, share: float, delay: float, seed: int
) -> None:
    plant, spacing_s = system.gains(), spacing_of(system, share)
    delay_s = delay * spacing_s
    accumulation = LossAccumulation(plant, delay_s)
    ages_s = lost_ages_s(seed, spacing_s, window)
    for output in plant.outputs:
        bound = accumulation.total(output, spacing_s, [window])
        assert worst_sum(effects(plant, output, delay_s, ages_s)) <= bound * ROUNDING


def periodic(system: System, spacing_s: float, window: LossWindow) -> float:
    """The effect of losing the ``losses`` newest of every ``packets`` events, at the worst time."""
    plant, every = system.gains(), np.arange(EVENTS)
    lost = every[every % window.packets < window.losses]
    found = [
        worst_sum(effects(plant, Output.STATE, 0.0, (lost + phase) * spacing_s))
        for phase in np.arange(0.0, window.packets, 0.5)
    ]
    return max(found)


@settings(SEARCH, max_examples=6)
@given(systems(n=1, m=1, mismatch=0.1), windows, st.sampled_from([0.3, 1.0]))
def test_a_loop_of_one_state_nearly_reaches_the_bound(
    system: System, window: LossWindow, share: float
) -> None:
    """Its kernels have one sign; a bound without any one loss would be exceeded."""
    spacing_s = spacing_of(replace(system, alpha=0.5 * system.alpha), share)
    system = replace(system, alpha=0.5 * system.alpha)
    bound = LossAccumulation(system.gains(), 0.0).total(Output.STATE, spacing_s, [window])
    reached = periodic(system, spacing_s, window)
    assert reached <= bound * ROUNDING <= 1.5 * reached


def test_more_losses_or_fewer_deliveries_never_have_a_smaller_bound() -> None:
    """Also beyond the grid, and where events are too close for any bound."""

    @settings(SEARCH, max_examples=5)
    @given(systems(), windows, shares)
    def check(system: System, window: LossWindow, share: float) -> None:
        spacing_s, found = spacing_of(system, share), LossAccumulation(system.gains(), 0.0)
        bound = found.total(Output.STATE, spacing_s, [window])
        more = LossWindow(window.losses + 1, window.packets + 1)
        assert found.total(Output.STATE, spacing_s, [more]) >= bound * (1 - 1e-9)
        assert found.total(Output.STATE, 1e-9 * spacing_s, [window]) == np.inf
        assert found.total(Output.STATE, spacing_s, [window, LossWindow(0, 1)]) == 0

    check()


@pytest.mark.parametrize(
    ("rule", "burst_only", "with_windows"),
    [
        (LongestBurst(4), 6.33, 6.33),
        (LossesInWindow(4, 20), 6.33, 4.50),
        (LossesInWindow(2, 20), 4.60, 3.35),
        (LossesInWindow(1, 10), 3.70, 2.87),
    ],
    ids=str,
)
def test_the_table_of_the_documents(
    rule: LongestBurst | LossesInWindow, burst_only: float, with_windows: float
) -> None:
    one = np.ones((1, 1))
    plant = PlantGains(ErrorGains(-5 * one, -6 * one, one, 0.5), 1.05 * one, one, one, 0.5)
    for constraints, expected in (((), burst_only), ((rule,), with_windows)):
        conditions = NetworkConditions(rule.limit, constraints=constraints)
        found = solve(plant.error, plant, conditions, TriggerBound(1.0, 1.0))
        assert found.state == pytest.approx(expected, abs=0.006)
