"""The paper's bounds: recomputed from the formulas; never exceeded under their assumptions."""

import math
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from cosim.simulation.continuous import ContinuousLoop, simulate_continuous
from noack.core.linear_systems import Matrix, Vector, spectral_abscissa
from noack.scenario.resolution import LoopMatrices, loop_of
from noack.theory.paper import (
    ErrorMonitor,
    InterEventTrajectory,
    Theorem2,
    _theorem_2,
    longest_interval_s,
    theorem_1,
    theorem_2,
)
from noack.theory.response_bounds import bound_response
from noack.trigger_policies.trigger_rule import TriggerRule
from tests.helpers.example_rules import decaying_rule
from tests.helpers.shipped import resolved
from tests.oracles.lossy_loops import ROUNDING, SEARCH, System, seeds, systems


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
    growing, identity = system.H + system.alpha * np.eye(loop.n), np.eye(loop.n)
    assume(spectral_abscissa(growing) < 0)
    delta = 1 + system.mansd * bound_response(growing, identity, identity).largest
    paper = theorem_2(loop, system.beta, system.alpha, delta)
    assert paper is not None
    return loop, paper


@settings(SEARCH, max_examples=6)
@given(systems())
def test_theorem_2_is_what_its_equations_say(system: System) -> None:
    """Every quantity recomputed from eq:tau, eq:Htil and eq:normXt; F at t_i = 0 and far out."""
    loop, paper = of(system)
    closed, alpha, bar = loop.A + loop.B @ loop.K, system.alpha, paper.alpha_bar_per_s
    assert alpha < bar < -spectral_abscissa(closed)
    fast = float(np.abs(np.linalg.eigvals(closed)).max())
    t_s = np.concatenate([np.linspace(0, 20 / fast, 300), np.linspace(0, 20 / (bar - alpha), 300)])
    sampled = np.linalg.norm(expm((closed + bar * np.eye(loop.n)) * t_s[:, None, None]), 2, (1, 2))
    # ‖e^{(A+BK)t}‖ ≤ c e^{−ᾱt}, and c is near its smallest possible value.
    assert sampled.max() / ROUNDING <= paper.c <= 1.1 * sampled.max()
    beta, delta, c = system.beta, paper.delta, paper.c
    BK, gap, x0 = norm(loop.B @ loop.K), bar - alpha, float(np.linalg.norm(system.x0))
    tilde, hat = norm(loop.A + loop.B @ loop.K - loop.H), norm(loop.H)
    F_bar = tilde * c * (x0 - beta * delta * BK / gap)
    F = (1 + tilde * c / gap) * beta * delta * BK
    least_s = math.inf
    for t_i in (0.0, 1.0 / gap, 1e9):
        bold_F = F_bar * math.exp(-gap * t_i) / (hat + bar) + F / (hat + alpha)
        least_s = min(least_s, math.log(1 + beta / bold_F) / (hat + bar))
    assert paper.inter_event_s == pytest.approx(least_s, rel=1e-12)
    assert (paper.a_hat, paper.a_tilde) == pytest.approx((hat, tilde))
    for t in (0.0, 0.3, 5.0):
        right = c * x0 * math.exp(-bar * t) + beta * c * delta * BK / gap * (
            math.exp(-alpha * t) - math.exp(-bar * t)
        )
        assert paper.state(np.array([t]), alpha)[0] == pytest.approx(right, rel=1e-12)


@settings(SEARCH, max_examples=2)
@given(systems(), seeds)
def test_theorem_2_is_never_exceeded_in_the_papers_loop(system: System, seed: int) -> None:
    loop, paper = of(system)
    horizon_s = 10.0 / float(np.abs(np.linalg.eigvals(system.H)).max())
    t_s = np.linspace(0.0, horizon_s, 500)
    rng = np.random.default_rng(seed)
    for loss_rate in (1.0, 0.7, 0.3):
        run = simulate_continuous(
            ContinuousLoop(loop, decaying_rule(system.beta, system.alpha, n=loop.n)),
            horizon_s=horizon_s,
            delivered=allowed(rng.random(2000) < loss_rate, system.mansd),
            known_start=True,
        )
        sizes = np.linalg.norm(run.at(t_s).x, axis=1)
        assert (sizes <= paper.state(t_s, system.alpha) * ROUNDING).all()
        assert np.diff(run.event_s).min(initial=np.inf) >= paper.inter_event_s / ROUNDING


def allowed(lost: np.ndarray, mansd: int) -> list[bool]:
    """Which updates arrive if at most ``mansd`` consecutive ones of those are lost."""
    delivered, burst = list[bool](), 0
    for is_lost in lost.tolist():
        burst = burst + 1 if is_lost and burst < mansd else 0
        delivered.append(burst == 0)
    return delivered


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
    longest_s = longest_interval_s(InterEventTrajectory(t_s, x, model), beta, alpha, kappa)
    assert expected * (1 - 1e-9) <= longest_s <= 1.02 * expected


def test_a_trajectory_through_0_has_no_longest_interval() -> None:
    t_s = np.linspace(0, 1, 11)
    through = InterEventTrajectory(t_s, np.abs(t_s - 0.5), np.ones(11))
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
    assert growing == pytest.approx(1 + math.exp(0.35) * math.exp(0.5), rel=2e-3)


@pytest.mark.parametrize("name", ["f16_lateral", "reactor_petc"])
def test_no_other_rate_gives_theorem_2_a_longer_inter_event_time(name: str) -> None:
    loop, beta, alpha, delta = loop_of(resolved(name)), 0.5, 0.25, 3.0
    closed, best = loop.A + loop.B @ loop.K, theorem_2(loop, beta, alpha, delta)
    assert best is not None
    for rate in alpha + np.linspace(0.05, 0.95, 10) * (-spectral_abscissa(closed) - alpha):
        c = bound_response(closed + rate * np.eye(loop.n), np.eye(loop.n), np.eye(loop.n)).largest
        other = _theorem_2(loop, beta, alpha, delta, rate, float(c))
        assert other.inter_event_s <= 1.001 * best.inter_event_s


def test_theorem_2_requires_a_threshold_that_decays_more_slowly_than_the_loop() -> None:
    unit = np.ones((1, 1))
    names = ("x",)
    loop = LoopMatrices(unit, unit, -3 * unit, -2 * unit, unit, unit, np.ones(1), None, names, names)
    assert theorem_2(loop, 0.1, 1.99, 1.0) is not None
    assert theorem_2(loop, 0.1, 2.0, 1.0) is None
    assert theorem_2(loop, 0.1, 0.0, 1.0) is None


PERIOD_NS = 10_000_000
NS = 1e-9


class Moment(NamedTuple):
    """A measurement: the monitor's arguments, and the true e_c."""

    t_ns: int
    e_s: Vector
    event: int
    received: int
    e_c: Vector


class History(NamedTuple):
    """A run of the two models with an arbitrary plant trajectory."""

    H: Matrix
    weight: Matrix
    moments: list[Moment]


@st.composite
def histories(draw: st.DrawFn) -> History:
    """Random motion of x, random events, updates that arrive late, out of order or never.

    The models follow their own update laws here; (I1) is not used.
    """
    n, rng = draw(st.integers(1, 4)), np.random.default_rng(draw(seeds))
    H = rng.normal(size=(n, n)) if draw(st.booleans()) else np.zeros((n, n))
    H -= rng.uniform(0, 1) * np.eye(n) * H.any()
    weight = np.eye(n) if draw(st.booleans()) else rng.normal(size=(n, n)) + 2 * np.eye(n)
    x = rng.normal(size=n)
    x_s, x_c = x.copy(), x.copy()
    t_ns, received, moments = 0, -1, []
    in_flight: list[tuple[int, int, Vector]] = []
    sent = 0
    for _ in range(draw(st.integers(1, 25))):
        step_ns = int(rng.integers(0, 30)) * PERIOD_NS
        t_ns += step_ns
        moved = expm(H * step_ns * NS)
        x, x_s, x_c = x + rng.normal(size=n), moved @ x_s, moved @ x_c
        e_s, event = x_s - x, -1
        if rng.uniform() < 0.5:
            event, x_s = sent, x.copy()
            sent += 1
            if rng.uniform() < 0.6:  # the others are lost
                in_flight.append((event, t_ns, x.copy()))
        for update in [u for u in in_flight if rng.uniform() < 0.5]:
            in_flight.remove(update)
            sequence, then_ns, state = update
            if sequence > received:
                received, x_c = sequence, expm(H * (t_ns - then_ns) * NS) @ state
        moments.append(Moment(t_ns, e_s, event, received, x_c - x))
    return History(H, weight, moments)


def follow(history: History, trigger: TriggerRule, at_once: int = 25) -> list[tuple[float, float, Vector]]:
    """Return both bounds, and (I1), at each moment; the monitor takes ``at_once`` moments each time."""
    monitor, followed = ErrorMonitor(history.H, trigger, PERIOD_NS), []
    for first in range(0, len(history.moments), at_once):
        columns = zip(*history.moments[first : first + at_once], strict=True)
        t_ns, e_s, events, received, _ = map(np.array, columns)
        bounds = monitor.take(t_ns, e_s, events, received)
        followed += zip(bounds.identity.tolist(), bounds.printed.tolist(), bounds.missed, strict=True)
    return followed


def explicit(history: History, trigger: TriggerRule, upto: int) -> tuple[float, float]:
    """Both sums, term by term, from the first event on."""

    def threshold(t_ns: int) -> float:
        return max(trigger.level * math.exp(-trigger.rate_per_s * t_ns * NS), trigger.floor)

    H, W, now = history.H, history.weight, history.moments[upto]
    identity = 0.0 if now.event >= 0 else float(np.linalg.norm(W @ now.e_s))
    printed = threshold(now.t_ns)
    for moment in history.moments[: upto + 1]:
        if moment.event > now.received:
            moved = expm(H * (now.t_ns - moment.t_ns) * NS)
            identity += float(np.linalg.norm(W @ moved @ moment.e_s))
            growth = np.linalg.norm(W @ moved @ np.linalg.inv(W), 2)
            printed += threshold(moment.t_ns) * float(growth)
    return identity, printed


@settings(max_examples=15)
@given(histories(), st.floats(0.01, 2.0), st.sampled_from([0.0, 0.3]), st.integers(1, 25))
def test_both_bounds_are_the_explicit_sums(
    history: History, alpha: float, floor: float, at_once: int
) -> None:
    trigger = decaying_rule(0.5, alpha, floor, history.weight)
    for upto, bounds in enumerate(follow(history, trigger, at_once)):
        expected = explicit(history, trigger, upto)
        assert bounds[:2] == pytest.approx(expected, rel=1e-9, abs=1e-12)


@settings(max_examples=15)
@given(histories(), st.integers(1, 25))
def test_the_identity_holds_for_every_trigger_plant_and_network(history: History, at_once: int) -> None:
    """It is x_c − x_s, and bounds the error; no assumption on trigger, plant or network."""
    trigger = decaying_rule(1e-3, 1.0, 0.0, history.weight)
    largest = 0.0
    for moment, bounds in zip(history.moments, follow(history, trigger, at_once), strict=True):
        error = float(np.linalg.norm(history.weight @ moment.e_c))
        largest = max(largest, error)
        assert error <= bounds[0] + 1e-12 * max(largest, 1.0)
        between = moment.e_c if moment.event >= 0 else moment.e_c - moment.e_s
        np.testing.assert_allclose(bounds[2], between, rtol=0, atol=1e-9 * max(largest, 1.0))
