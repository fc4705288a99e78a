"""The paper's bounds: recomputed from the formulas; never exceeded under their assumptions."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from scipy.linalg import expm

from noack.core.linear_systems import Matrix, spectral_abscissa
from noack.scenario.resolution import LoopMatrices
from noack.theory.bounds.terms import NetworkConditions
from noack.theory.paper import Interval, Theorem2, longest_interval_s, theorem_1, theorem_2
from tests.noack.theory.certificate_kinds.policies import INSTANT
from tests.oracles.continuous_loops import simulate_continuous_time
from tests.oracles.lossy_loops import (
    ROUNDING,
    SEARCH,
    System,
    certified_or_skipped,
    networks,
    seeds,
    systems,
    times_s,
)


def norm(matrix: Matrix) -> float:
    return float(np.linalg.norm(matrix, 2))


def of(system: System) -> tuple[LoopMatrices, Theorem2]:
    """Theorem 2 with the uniform Δ from (I1)."""
    names = tuple(f"x_{i}" for i in range(len(system.A)))
    loop = LoopMatrices(
        A_model=system.H - system.B @ system.K, B_model=system.B, K=system.K, H=system.H,
        A=system.A, B=system.B, x0=system.x0, weight=None,
        state_names=names, input_names=names[: len(system.K)],
    )  # fmt: skip
    delta = certified_or_skipped(system, NetworkConditions(system.mansd)).delta
    found = theorem_2(loop, system.beta, system.alpha, delta)
    assert found is not None
    return loop, found


@settings(SEARCH, max_examples=3)
@given(systems(weighted=False))
def test_theorem_2_is_what_its_equations_say(system: System) -> None:
    """Every quantity recomputed from eq:tau, eq:Htil and eq:normXt; F at t_i = 0 and far out."""
    loop, found = of(system)
    closed, alpha, bar = loop.A + loop.B @ loop.K, system.alpha, found.alpha_bar_per_s
    assert alpha < bar < -spectral_abscissa(closed)
    fast = float(np.abs(np.linalg.eigvals(closed)).max())
    t_s = np.concatenate([np.linspace(0, 20 / fast, 300), np.linspace(0, 20 / (bar - alpha), 300)])
    sampled = np.linalg.norm(expm((closed + bar * np.eye(loop.n)) * t_s[:, None, None]), 2, (1, 2))
    # ‖e^{(A+BK)t}‖ ≤ c e^{−ᾱt}, and c is close to its smallest possible value.
    assert sampled.max() / ROUNDING <= found.c <= 1.01 * sampled.max()
    beta, delta, c = system.beta, found.delta, found.c
    BK, gap, x0 = norm(loop.B @ loop.K), bar - alpha, float(np.linalg.norm(system.x0))
    tilde, hat = norm(loop.A + loop.B @ loop.K - loop.H), norm(loop.H)
    F_bar = tilde * c * (x0 - beta * delta * BK / gap)
    F = (1 + tilde * c / gap) * beta * delta * BK
    least_s = math.inf
    for t_i in (0.0, 1.0 / gap, 1e9):
        bold_F = F_bar * math.exp(-gap * t_i) / (hat + bar) + F / (hat + alpha)
        least_s = min(least_s, math.log(1 + beta / bold_F) / (hat + bar))
    assert found.inter_event_s == pytest.approx(least_s, rel=1e-12)
    assert (found.a_hat, found.a_tilde) == pytest.approx((hat, tilde))
    for t in (0.0, 0.3, 5.0):
        right = c * x0 * math.exp(-bar * t) + beta * c * delta * BK / gap * (
            math.exp(-alpha * t) - math.exp(-bar * t)
        )
        assert found.state(np.array([t]), alpha)[0] == pytest.approx(right, rel=1e-12)


@settings(SEARCH, max_examples=3)
@given(systems(weighted=False, **INSTANT), seeds)
def test_theorem_2_is_never_exceeded_in_the_papers_loop(system: System, seed: int) -> None:
    _, found = of(system)
    trace, t_s = simulate_continuous_time(system, *networks(seed, system)), times_s(system)
    bounds = np.exp(system.alpha * t_s) * found.state(t_s, system.alpha)
    assert trace.state.max() <= bounds.max() * ROUNDING
    assert trace.inter_event_s >= found.inter_event_s / ROUNDING


@pytest.mark.parametrize("alpha", [0.1, 2.0])
def test_the_slower_of_model_and_threshold_determines_the_interval(alpha: float) -> None:
    """δ̄ = ln((ζ + βe^{−αt_j})/η)/(γ + min(κ, α)), for the best γ on any grid."""
    beta, kappa, t_s = 0.2, 0.5, np.linspace(1.0, 1.4, 100)
    passed_s = t_s - 1.0
    x, model = 0.8 + passed_s, np.exp(-kappa * passed_s) * (1 + 0.3 * passed_s)
    zeta, level = 1.12, beta * math.exp(-alpha)  # ζ at the end: 1 + 0.3 · 0.4
    expected = min(
        math.log((zeta + level) / eta) / (gamma + min(kappa, alpha))
        for gamma in np.geomspace(1e-3, 1e3, 2000)
        if (eta := float((x * np.exp(-gamma * passed_s)).min())) > 0
    )
    found = longest_interval_s(Interval(t_s, x, model), beta, alpha, kappa)
    assert expected * (1 - 1e-9) <= found <= 1.02 * expected


def test_a_trajectory_through_0_has_no_longest_interval() -> None:
    t_s = np.linspace(0, 1, 11)
    through = Interval(t_s, np.abs(t_s - 0.5), np.ones(11))
    assert longest_interval_s(through, 0.1, 0.5, 0.5) == math.inf
    assert theorem_1(-np.eye(1), 0.5, [math.inf]) == math.inf
    assert theorem_1(-np.eye(1), 0.5, [1e6]) == math.inf  # e^{5e5} overflows


def test_theorem_1_agrees_with_a_hand_calculation() -> None:
    """H = −1, or 0: 1 + Σ e^{αδ̃_k} sup e^{−τ}, the sup at τ = 0."""
    delays_s = [0.3, 0.5, 0.1]
    expected = 1 + sum(math.exp(0.7 * reach) for reach in (0.9, 0.6, 0.1))
    for H in (-np.eye(1), np.zeros((2, 2))):
        assert theorem_1(H, 0.7, delays_s) == pytest.approx(expected, rel=1e-5)
    assert theorem_1(-np.eye(1), 0.7, []) == 1.0
    growing = theorem_1(np.eye(1), 0.7, [0.5])
    assert growing == pytest.approx(1 + math.exp(0.35) * math.exp(0.5), rel=1e-4)
