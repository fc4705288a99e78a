"""Published results on the policies, against the exact simulator.

Each docstring states whether its figures are printed in the source or follow from a theorem there.
What ETCetera and Tabuada (2007) print is in ``noack paper``.
"""

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import quad
from scipy.linalg import expm, solve_continuous_lyapunov
from scipy.optimize import brentq

from cosim.simulation.continuous import (
    ContinuousLoop,
    ContinuousRun,
    continuous_loop_of,
    simulate_continuous,
)
from noack.scenario.resolution import LoopMatrices, resolve
from noack.scenario.scenario_file import load
from noack.trigger.trigger_rule import TriggerRule
from tests.trigger_rules import absolute_rule, lyapunov_rule

Matrix = NDArray[np.float64]
System = tuple[Matrix, Matrix, Matrix]
"""A, B, K."""


def shipped(name: str, *settings: str) -> ContinuousLoop:
    path = Path(__file__).parents[4] / "scenarios" / f"{name}.toml"
    return continuous_loop_of(resolve(load(path, list(settings))))


def system_of(loop: ContinuousLoop) -> System:
    return loop.loop.A, loop.loop.B, loop.loop.K


TABUADA = system_of(shipped("tabuada_dynamic"))
REACTOR = system_of(shipped("reactor_petc"))


def held(system: System, policy: TriggerRule) -> ContinuousLoop:
    """The loop of the literature: held input, and a model equal to the plant."""
    A, B, K = system
    n, m = B.shape
    names = tuple(f"x_{i}" for i in range(n)), tuple(f"u_{i}" for i in range(m))
    loop = LoopMatrices(A, B, K, np.zeros((n, n)), A, B, np.ones(n), None, *names)
    return ContinuousLoop(loop, policy)


def run_from(
    x0: Matrix, loop: ContinuousLoop, horizon_s: float, max_events: int = 5000
) -> ContinuousRun:
    """A run in which every update arrives."""
    return simulate_continuous(
        loop, horizon_s=horizon_s, delivered=[], known_start=True, x0=x0, max_events=max_events
    )


def between(run: ContinuousRun) -> Matrix:
    """Inter-event times, from t = 0 on."""
    times: Matrix = np.diff(run.event_s, prepend=0.0)
    return times


def step(system: System, t_s: float) -> Matrix:
    """M of x(t_k + t) = M x(t_k), by a matrix exponential."""
    A, B, K = system
    n = len(A)
    both = expm(np.block([[A, B @ K], [np.zeros((n, 2 * n))]]) * t_s)
    found: Matrix = both[:n, :n] + both[:n, n:]
    return found


def test_the_lyapunov_rule_meets_its_minimum_time_and_no_earlier_one() -> None:
    """Theorem: with S = V(x_k) e^{−ρt}, no event before the first t at which some state meets S.

    Mazo, Anta, Tabuada, Automatica 46(8), 2010; there as a determinant that vanishes, here as
    ‖L M(t) L⁻¹‖ = e^{−ρt/2}, P = LᵀL, x(t_k + t) = M(t) x_k. It is attained, in the direction of
    the largest singular value. On the batch reactor.
    """
    A, B, K = REACTOR
    lyapunov = solve_continuous_lyapunov((A + B @ K).T, -np.eye(4))
    L = np.linalg.cholesky(lyapunov).T
    rate_per_s = 0.5 / float(np.linalg.eigvalsh(lyapunov)[-1])

    def above(t_s: float) -> float:
        moved = np.linalg.norm(L @ step(REACTOR, t_s) @ np.linalg.inv(L), 2)
        return float(moved - math.exp(-rate_per_s * t_s / 2))

    t_s = np.linspace(1e-3, 1.0, 2000)
    i = next(i for i in range(len(t_s)) if above(t_s[i]) > 0)
    assert i > 0
    shortest_s = brentq(above, t_s[i - 1], t_s[i], xtol=1e-14)
    loop = held(REACTOR, lyapunov_rule(L, rate_per_s))
    worst = np.linalg.svd(L @ step(REACTOR, shortest_s) @ np.linalg.inv(L))[2][0]
    met = run_from(np.linalg.solve(L, worst), loop, 1.5 * shortest_s)
    # the square root of the rounding error
    assert met.event_s[0] == pytest.approx(shortest_s, rel=1e-6)
    for x0 in np.random.default_rng(2).normal(size=(8, 4)):
        assert (between(run_from(x0, loop, 2.0)) >= shortest_s * (1 - 1e-6)).all()


@pytest.mark.parametrize("delta", [0.3, 0.011])
def test_send_on_delta_samples_a_first_order_response_at_its_levels(delta: float) -> None:
    """Follows from the definition: e^{−t/τ} is reported at t_k = −τ ln(1 − kδ), ⌊1/δ⌋ times.

    Miskowicz, Sensors 6(1), 2006, takes the step response of a first-order system as an example.
    """
    tau_s = 0.8
    system = np.array([[-1 / tau_s]]), np.array([[1.0]]), np.array([[0.0]])
    run = run_from(np.array([1.0]), held(system, absolute_rule(delta, n=1)), 40.0)
    k = np.arange(1, math.floor(1 / delta) + 1)
    np.testing.assert_allclose(run.event_s, -tau_s * np.log1p(-k * delta), rtol=1e-9)


def test_the_distance_to_the_continuous_loop_is_within_lunze_and_lehmanns_bound() -> None:
    """Theorem: ‖x − x_CT‖ ≤ ē ∫₀^∞ ‖e^{(A+BK)s} BK‖ ds for a generator with ‖e‖ ≤ ē.

    Lunze, Lehmann, Automatica 46(1), 2010. Sensor and controller run the same model. The
    disturbance is a plant mismatch, here in both loops; without a disturbance there is no event,
    as they remark.
    """
    A, B, K = TABUADA
    closed, level = A + B @ K, 0.2
    names = ("x_1", "x_2"), ("u",)
    same = LoopMatrices(A, B, K, closed, A, B, np.array([1.0, 0.0]), None, *names)
    other = A + np.array([[0.0, 0.0], [0.3, -0.4]])
    disturbed = LoopMatrices(A, B, K, closed, other, B, np.array([1.0, 0.0]), None, *names)
    gain, _ = quad(
        lambda s: float(np.linalg.norm(expm((other + B @ K) * s) @ B @ K, 2)), 0, 60, limit=200
    )
    quiet = ContinuousLoop(same, absolute_rule(level))
    assert len(run_from(np.array([10.0, 0.0]), quiet, 10.0).event_s) == 0
    loop, x0 = ContinuousLoop(disturbed, absolute_rule(level)), np.array([10.0, -5.0])
    run = run_from(x0, loop, 10.0)
    assert len(run.event_s) > 5
    t_s = np.linspace(0.0, 10.0, 500)
    continuous = np.stack([expm((other + B @ K) * t) @ x0 for t in t_s])
    apart = np.linalg.norm(run.at(t_s).x - continuous, axis=1).max()
    assert 0.1 * level * gain < apart <= level * gain
