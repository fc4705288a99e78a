"""Moments of a loop: published figures, closed forms, other coordinates."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov

from netem.guarantee.loss_guarantee import LossGuarantee
from netem.impairments.constraints import join_guarantee
from netem.impairments.target_loss import loss_process
from noack.core.linear_systems import Matrix
from noack.scenario.resolution import loop_of
from noack.theory.random_losses.exact_moments import (
    LoopMoments,
    LoopPeriods,
    MomentStep,
    jump,
    periods_of,
    propagation,
    start_of,
)
from noack.theory.time_triggered.exact_matrices import exactly
from noack.theory.time_triggered.scenario_times import loop_times
from noack.theory.time_triggered.time_triggered_loop import TimeTriggeredLoop, repeated
from tests.noack.theory.random_losses.example_losses import BURSTS, NOISE, scenario


def integrator() -> tuple[MomentStep, MomentStep]:
    """A flow of 0.1 of ẋ = u + noise, and the controller; the state is (x, sample, u)."""
    K = -(3 + np.sqrt(3)) / (2 + np.sqrt(3))
    G, unit = np.zeros((3, 3)), np.diag([1.0, 0.0, 0.0])
    G[0, 2] = 1.0
    sampler = np.array([[1.0, 0, 0], [1, 0, 0], [0, 0, 1]])
    controller = np.array([[1.0, 0, 0], [0, 1, 0], [0, K, 0]])
    return propagation(G, unit, unit[None], 0.1), jump(sampler, 1).then(jump(controller, 1))


def test_moments_are_those_of_the_first_example_of_jitter_time() -> None:
    """The figures are those of X-N-C/JitterTime.jl, test/example_1_test.jl and test_periodic.jl."""
    tenth, sample = integrator()
    period = repeated(tenth, 10).then(sample)
    run = repeated(tenth, 20).then(repeated(period, 4))
    assert run.constants[0] == pytest.approx(7.420841162336913, rel=1e-13)
    variance = [1.078061834694495, 1.078061834694495, -1.366927632691700]
    assert run.noise[0] == pytest.approx(np.array(variance), rel=1e-13)
    stationary = solve_discrete_lyapunov(period.matrix, period.noise)
    assert stationary[2, 2] == pytest.approx(1.732050807568876, rel=1e-13)
    assert stationary[0, 0] == pytest.approx(1.077350269189626, rel=1e-13)


def test_moments_are_those_of_the_second_example_of_jitter_time() -> None:
    """Pendulum with two observers, as in test/example_2_test.jl of X-N-C/JitterTime.jl.

    The state is (x (2), sensors (2 each), observer (3) and its output (3), input).
    """
    eye = np.eye(13)
    x, first, second, memory, estimate, u = np.split(eye, [2, 4, 6, 9, 12])

    def execute(rows: Matrix, target: slice, noise: float = 0.0, at: int = 0) -> MomentStep:
        M, W = eye.copy(), np.zeros((13, 13))
        M[target], W[at, at] = rows, noise
        return jump(M, 1, W)

    def observer(A: list[list[float]], B: list[list[float]]) -> MomentStep:
        # Its inputs are the input, the position of sensor 1, the velocity of sensor 2.
        inputs = np.vstack([u, first[:1], second[1:]])
        rows = np.array(A) @ memory + np.array(B) @ inputs
        return execute(np.vstack([rows, rows]), slice(6, 12))

    G = x.T @ (np.array([[0.0, 1.0], [1.0, 0.0]]) @ x + np.array([[0.0], [1.0]]) @ u)
    weight, noise = np.diag([1.0, 0.1, *np.zeros(10), 0.1]), np.diag(eye[1])
    passed = propagation(G, noise, weight[None], 0.05)
    by_first = execute(x, slice(2, 4), 0.1, 2).then(
        observer([[0.5309, 0.079, 0], [-0.8673, 0.8597, 0], [0, 0, 0]],
                 [[0.0059, 0.475, 0], [0.1392, 1.0065, 0], [1, 0, 0]])
    )  # fmt: skip
    by_second = execute(x, slice(4, 6), 0.01, 5).then(
        observer([[1, -0.3906, 0], [0, 0.0163, 0], [0, 0, 1]],
                 [[0, 0, 0.3906], [0, 0, 0.9837], [0, 0, 0]])
    )  # fmt: skip
    feedback = execute(-np.array([[3.633, 2.7434, 0.0]]) @ estimate, slice(12, 13))
    run = jump(eye, 1)
    for t in range(1, 241):
        run = run.then(passed)
        run = run.then(by_second) if t % 10 == 0 else run
        run = run.then(by_first).then(feedback) if t % 3 == 0 else run
    assert run.constants[0] == pytest.approx(12.574852494566098, rel=1e-12)
    assert run.noise[0, 0] == pytest.approx(0.334482211088805, rel=1e-12)


def test_without_losses_the_moments_solve_a_lyapunov_equation() -> None:
    given = scenario(**NOISE, network={"mansd": 0, "loss": BURSTS})
    periods = periods_of(given, np.zeros((0, 3, 3)))
    moments = LoopMoments(periods, loss_process(given.network.link).outcomes(join_guarantee(0, ())))
    stationary, period = moments.stationary(), periods.step(0, delivered=True)
    assert stationary is not None
    expected = solve_discrete_lyapunov(period.matrix, period.noise)
    assert stationary[0].moments.sum(axis=0) == pytest.approx(expected, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize(("behind", "delay"), [(0, 0.0), (0, 0.07), (1, 0.0), (2, 0.07)])
def test_the_maps_with_all_rounding_contain_those_of_the_moments(behind: int, delay: float) -> None:
    """Traces of products are the same in all units; the ticks drift against the transmissions."""
    given = scenario(network={"mansd": 2, "loss": BURSTS}, **{"controller.rate_hz": 16.0})
    loop, times = loop_of(given), loop_times(given, 10)
    times = times._replace(delay=round(delay * 1e9), behind=behind)
    nothing = np.zeros((2, 2))
    periods = LoopPeriods(loop, times, nothing, nothing, np.zeros((0, 3, 3)))
    exact = TimeTriggeredLoop(loop.A, loop.B, loop.K, loop.H, times)
    for slot, outcomes in product(range(times.slots), product([True, False], repeat=3)):
        products = np.eye(periods.size), exactly(np.eye(periods.size))
        for delivered in outcomes:
            enclosed = exact.period(slot, delivered)
            products = periods.step(slot, delivered).matrix @ products[0], enclosed @ products[1]
        rounded, enclosed = products
        assert np.trace(rounded) == pytest.approx(np.trace(enclosed.middle), rel=1e-11, abs=1e-11)
        assert np.trace(enclosed.radius) < 1e-11


def test_moments_do_not_depend_on_the_units_of_the_states() -> None:
    given = scenario(**NOISE, network={"mansd": 2, "loss": BURSTS}, **{"controller.rate_hz": 16.0})
    outcomes = loss_process(given.network.link).outcomes(join_guarantee(2, ()))
    loop, unit = loop_of(given), 2.0 ** np.array([-25, 20])
    T = unit[:, None]
    other = replace(loop, A=T * loop.A / unit, B=T * loop.B, K=loop.K / unit, H=T * loop.H / unit)
    costs = []
    for matrices, units in (loop, np.ones(2)), (other, unit):
        noise, form = np.diag((0.1 * units) ** 2), np.diag([*units**-2, 1.0])
        periods = LoopPeriods(matrices, loop_times(given, 10), noise, 0 * noise, form[None])
        stationary = LoopMoments(periods, outcomes).stationary()
        assert stationary is not None
        costs.append(stationary[1][0])
    assert costs[1] == pytest.approx(costs[0], rel=1e-9)


@pytest.mark.parametrize("guarantee", [join_guarantee(2, ()), LossGuarantee()])
def test_many_periods_are_the_sum_of_few(guarantee: LossGuarantee) -> None:
    """Many are computed by a power of the cycle's map."""
    given = scenario(**NOISE, network={"mansd": 2, "loss": BURSTS}, **{"controller.rate_hz": 10.0})
    outcomes = loss_process(given.network.link).outcomes(guarantee)
    periods = periods_of(given, np.eye(3)[None])
    moments, start = LoopMoments(periods, outcomes), start_of(given, outcomes, periods.size)
    few_ns, rest_ns = 8 * periods.times.slots * periods.times.period, 70_000_000
    many, costs = moments.until(start, 150 * few_ns + rest_ns)
    expected, expected_costs = start, np.zeros(1)
    for _ in range(150):
        expected, added = moments.until(expected, few_ns)
        expected_costs = expected_costs + added
    expected, added = moments.until(expected, rest_ns)
    np.testing.assert_allclose(many.shares, expected.shares, rtol=1e-10)
    np.testing.assert_allclose(many.moments, expected.moments, rtol=1e-9, atol=1e-9 * many.moments.max())
    np.testing.assert_allclose(costs, expected_costs + added, rtol=1e-9)
