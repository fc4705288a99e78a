"""The paper's bounds: recomputed from the formulas; never exceeded under their assumptions."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from cosim.simulation.continuous.continuous_run import ContinuousRun
from noack.config.resolution import LoopMatrices
from noack.core.linear_systems import Matrix, Vector, spectral_abscissa
from noack.theory.certificate import NetworkConditions
from noack.theory.paper_bounds import Interval, Theorem2, longest_interval_s, theorem_1, theorem_2
from tests.noack.theory.exact_loops import loop_of, observe
from tests.noack.theory.loops import (
    ROUNDING,
    SEARCH,
    System,
    certified_or_skipped,
    seeds,
    systems,
)

EVENTFUL = {"mismatch": 0.5, "beta": 0.01}


def norm(matrix: Matrix) -> float:
    return float(np.linalg.norm(matrix, 2))


def of(system: System) -> tuple[LoopMatrices, Theorem2]:
    """Theorem 2 with the uniform Δ from (I1)."""
    loop = loop_of(system)
    delta = certified_or_skipped(system, NetworkConditions(system.mansd)).delta
    found = theorem_2(loop, system.beta, system.alpha, delta)
    assert found is not None
    return loop, found


@settings(SEARCH, max_examples=4)
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


@settings(SEARCH, max_examples=4)
@given(systems(weighted=False))
def test_no_other_decay_rate_gives_a_longer_inter_event_time(system: System) -> None:
    """c and ᾱ are free parameters: the best of a fine grid is not much better."""
    loop, found = of(system)
    closed, x0 = loop.A + loop.B @ loop.K, float(np.linalg.norm(system.x0))
    slowest = -spectral_abscissa(closed)
    t_s = np.linspace(0, 40 / slowest, 800)
    moved = expm(closed * t_s[:, None, None])
    BK, tilde, hat = norm(loop.B @ loop.K), found.a_tilde, found.a_hat
    best_s = 0.0
    for share in np.linspace(0.01, 0.99, 99):
        bar = system.alpha + share * (slowest - system.alpha)
        c = float((np.linalg.norm(moved, 2, (1, 2)) * np.exp(bar * t_s)).max())
        gap, push = bar - system.alpha, system.beta * found.delta * BK
        F = max(tilde * c * (x0 - push / gap), 0.0) / (hat + bar)
        F += (1 + tilde * c / gap) * push / (hat + system.alpha)
        best_s = max(best_s, math.log1p(system.beta / F) / (hat + bar))
    assert best_s <= 1.05 * found.inter_event_s


def test_where_f_bar_is_negative_the_time_is_that_of_the_far_future() -> None:
    """From x(0) = 0, F grows with t_i, and its limit determines the bound."""
    one = np.ones((1, 1))
    names = ("x",)
    loop = LoopMatrices(
        one, one, -3 * one, -2 * one, 1.2 * one, one, np.zeros(1), None, names, names
    )
    beta, alpha, delta = 0.1, 0.5, 3.0
    found = theorem_2(loop, beta, alpha, delta)
    assert found is not None
    bar = found.alpha_bar_per_s
    assert found.c == pytest.approx(1.0, rel=1e-3)
    F = (1 + 0.2 * found.c / (bar - alpha)) * beta * delta * 3
    expected = math.log(1 + beta * (2 + alpha) / F) / (2 + bar)
    assert found.inter_event_s == pytest.approx(expected, rel=1e-12)
    away = theorem_2(replace(loop, x0=np.array([100.0])), beta, alpha, delta)
    assert away is not None
    assert away.inter_event_s < found.inter_event_s
    # Where the largest F is not at t_i = 0, using t_i = 0 would give too large a bound.
    at_0 = 0.2 * found.c * (0 - beta * delta * 3 / (bar - alpha)) / (2 + bar) + F / (2 + alpha)
    assert math.log(1 + beta / at_0) / (2 + bar) > found.inter_event_s


def test_theorem_2_requires_a_threshold_that_decays_more_slowly_than_the_loop() -> None:
    one = np.ones((1, 1))
    names = ("x",)
    loop = LoopMatrices(one, one, -3 * one, -2 * one, one, one, np.ones(1), None, names, names)
    assert theorem_2(loop, 0.1, 1.99, 1.0) is not None
    assert theorem_2(loop, 0.1, 2.0, 1.0) is None
    assert theorem_2(loop, 0.1, 0.0, 1.0) is None


@settings(SEARCH, max_examples=6)
@given(systems(weighted=False), seeds)
def test_theorem_2_is_never_exceeded_in_the_papers_loop(system: System, seed: int) -> None:
    _, found = of(system)
    for run, samples in observe(system, 12.0, seed):
        bound = found.state(samples.t_s, system.alpha)
        assert (np.linalg.norm(samples.x, axis=1) <= bound * ROUNDING).all()
        if len(run.before) > 1:
            assert np.diff(run.event_s).min() >= found.inter_event_s / ROUNDING


def missed_events(run: ContinuousRun) -> list[list[int]]:
    """The missed events between two deliveries, or to the end of the run."""
    found: list[list[int]] = []
    missed: list[int] = []
    for event, delivered in enumerate(run.delivered):
        missed = [] if delivered else [*missed, event]
        found.append(list(missed))
    return found


def interval(run: ContinuousRun, event: int) -> Interval:
    """From an event to the next, or to the end."""
    ends_s = [*run.event_s[1:], run.reached_s]
    t_s = np.linspace(run.event_s[event], ends_s[event], 60)
    state, H = run.after[event], run.system.loop.H
    inside = run.system.sample(state, t_s)
    model = expm(H * (t_s - t_s[0])[:, None, None]) @ state.x
    return Interval(t_s, np.linalg.norm(inside.x, axis=1), np.linalg.norm(model, axis=1))


def deltas(system: System, run: ContinuousRun) -> tuple[list[float], Vector]:
    """Theorem 1's Δ after each event, and the largest ‖e_c‖e^{αt}/β from there to the next one."""
    H, alpha, beta = run.system.loop.H, system.alpha, system.beta
    kappa = min(alpha, -spectral_abscissa(H)) if H.any() else 0.0
    intervals = [interval(run, event) for event in range(len(run.before))]
    longest_s = [longest_interval_s(found, beta, alpha, kappa) for found in intervals]
    lasted_s = [float(found.t_s[-1] - found.t_s[0]) for found in intervals]
    assert all(bound >= real / ROUNDING for bound, real in zip(longest_s, lasted_s, strict=True))
    claimed, seen = [], []
    for event, missed in enumerate(missed_events(run)):
        claimed.append(theorem_1(H, alpha, [longest_s[k] for k in missed]))
        t_s = intervals[event].t_s
        errors = run.system.norms(run.system.sample(run.after[event], t_s).e_c)
        seen.append(float((errors * np.exp(alpha * t_s)).max() / beta))
    return claimed, np.array(seen)


@settings(SEARCH, max_examples=5)
@given(systems(weighted=False, mansd=3, known_start=True, **EVENTFUL), seeds, st.booleans())
def test_theorem_1_is_never_exceeded_on_its_own_trajectory(
    system: System, seed: int, held: bool
) -> None:
    """Theorem 3, too, for a hold. δ̄_j is never shorter than the interval that it bounds."""
    if held:
        system = replace(system, H=np.zeros_like(system.H))
    for run, _ in observe(system, 6.0, seed, samples=2):
        if len(run.before) > 60:  # other examples contain runs that are long enough
            continue
        claimed, seen = deltas(system, run)
        assert (seen <= np.array(claimed) * ROUNDING).all()


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
