"""Mean costs: published figures, closed forms, all patterns of losses, simulated runs."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov

import noack
from cosim.analysis.mean_cost import CostUnder, find_mean_cost
from cosim.studies.campaign.drawn_runs import SampledWork
from noack.core.linear_systems import Matrix
from noack.impairments.constraints import join_guarantee
from noack.impairments.loss_guarantee import LossGuarantee
from noack.impairments.loss_prediction import loss_process
from noack.scenario.resolution import loop_of, resolve
from noack.scenario.scenario import Scenario
from noack.theory.margins.exact_matrices import exactly
from noack.theory.margins.loss_margin import loop_times
from noack.theory.margins.time_triggered_loop import TimeTriggeredLoop, repeated
from noack.theory.random_losses.exact_moments import (
    LoopMoments,
    LoopPeriods,
    MomentStep,
    flow,
    jump,
    periods_of,
    start_of,
)
from tests.command_line import invoke

NOISE = {
    "plant.disturbances": [
        {"kind": "gaussian", "std": [0.5]},
        {"kind": "uniform", "bound": [0.2, 0.4], "at": "state"},
    ],
    "plant.measurement.noise_std": [0.05, 0.1],
}
BURSTS = {"model": "gilbert_elliott", "good_to_bad": 0.3, "bad_to_good": 0.4, "loss_in_good": 0.1,
          "loss_in_bad": 0.9}  # fmt: skip


def scenario(**settings: object) -> Scenario:
    timing = {"plant.rate_hz": 40.0, "controller.rate_hz": 40.0, "horizon_s": 1.5}
    trigger = {"policy": "periodic", "period_s": 0.25}
    settings = {**timing, "trigger": trigger, "certificate.late_periods": 0, **settings}
    return resolve(noack.load("double_integrator", settings=settings))


def integrator() -> tuple[MomentStep, MomentStep]:
    """A flow of 0.1 of ẋ = u + noise, and the controller; the state is (x, sample, u)."""
    K = -(3 + np.sqrt(3)) / (2 + np.sqrt(3))
    G, unit = np.zeros((3, 3)), np.diag([1.0, 0.0, 0.0])
    G[0, 2] = 1.0
    sampler = np.array([[1.0, 0, 0], [1, 0, 0], [0, 0, 1]])
    controller = np.array([[1.0, 0, 0], [0, 1, 0], [0, K, 0]])
    return flow(G, unit, unit[None], 0.1), jump(sampler, 1).then(jump(controller, 1))


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
    passed = flow(G, noise, weight[None], 0.05)
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


def test_a_held_integrator_with_independent_losses_by_hand() -> None:
    """x⁺ = x + T(u + d), u⁺ = K x⁺ or u⁺ = u: the equations for E x², E xu and E u² = K² E x²."""
    T, K, sigma, p = 0.5, -0.8, 0.3, 0.4
    model = {"A": [[0.0]], "B": [[1.0]], "gain": [[K]]}
    found = find_mean_cost(
        scenario(
            model=model, mode="zoh",
            network={"mansd": 4, "loss": {"model": "bernoulli", "probability": p}},
            plant={"initial_state": [1.0], "rate_hz": 1 / T,
                   "disturbances": [{"kind": "gaussian", "std": [sigma]}]},
            trigger={"policy": "periodic", "period_s": T},
            controller={"rate_hz": 1 / T, "phase": 0.0},
        )
    ).without_guarantee  # fmt: skip
    q = 1 - p
    # A tick's input is applied a step later: u⁺ = K x if the update before was delivered.
    matrix = np.array([[0.0, 2 * T, T**2], [q * K, q * K * T + p - 1, p * T], [q * K**2, 0, p - 1]])
    a, b, c = np.linalg.solve(matrix, [-(T**2) * sigma**2, 0.0, 0.0])
    assert isinstance(found, CostUnder)
    assert found.stationary.state_rms_at_transmissions == pytest.approx([a**0.5], rel=1e-9)
    assert found.stationary.input_rms == pytest.approx([c**0.5], rel=1e-9)
    over_time = a + T * b + (T**2) * (c + sigma**2) / 3
    assert found.stationary.cost_per_s == pytest.approx(over_time + c, rel=1e-9)


def test_without_losses_the_moments_solve_a_lyapunov_equation() -> None:
    given = scenario(**NOISE, network={"mansd": 0, "loss": BURSTS})
    periods = periods_of(given, np.zeros((0, 3, 3)))
    moments = LoopMoments(periods, loss_process(given.network.link).outcomes(join_guarantee(0, ())))
    found, period = moments.stationary(), periods.step(0, delivered=True)
    assert found is not None
    expected = solve_discrete_lyapunov(period.matrix, period.noise)
    assert found[0].moments.sum(axis=0) == pytest.approx(expected, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("delay", [0.0, 0.07])
def test_the_maps_with_all_rounding_contain_those_of_the_moments(delay: float) -> None:
    """Traces of products are the same in all units; the ticks drift against the transmissions."""
    given = scenario(network={"mansd": 2, "loss": BURSTS}, **{"controller.rate_hz": 16.0})
    loop, times = loop_of(given), loop_times(given, 250_000_000)._replace(delay_ns=round(delay * 1e9))
    nothing = np.zeros((2, 2))
    periods = LoopPeriods(loop, times, nothing, nothing, np.zeros((0, 3, 3)))
    exact = TimeTriggeredLoop(loop.A, loop.B, loop.K, loop.H, times)
    for slot, outcomes in product(range(times.slots), product([True, False], repeat=3)):
        products = np.eye(6), exactly(np.eye(6))
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
    found = []
    for matrices, units in (loop, np.ones(2)), (other, unit):
        noise, form = np.diag((0.1 * units) ** 2), np.diag([*units**-2, 1.0])
        periods = LoopPeriods(matrices, loop_times(given, 250_000_000), noise, 0 * noise, form[None])
        stationary = LoopMoments(periods, outcomes).stationary()
        assert stationary is not None
        found.append(stationary[1][0])
    assert found[1] == pytest.approx(found[0], rel=1e-9)


@pytest.mark.parametrize("guarantee", [join_guarantee(2, ()), LossGuarantee()])
def test_many_periods_are_the_sum_of_few(guarantee: LossGuarantee) -> None:
    """Many are computed by a power of the cycle's map."""
    given = scenario(**NOISE, network={"mansd": 2, "loss": BURSTS}, **{"controller.rate_hz": 10.0})
    outcomes = loss_process(given.network.link).outcomes(guarantee)
    periods = periods_of(given, np.eye(3)[None])
    moments, start = LoopMoments(periods, outcomes), start_of(given, outcomes)
    few_ns, rest_ns = 8 * periods.times.slots * periods.times.period_ns, 70_000_000
    many, costs = moments.until(start, 150 * few_ns + rest_ns)
    expected, expected_costs = start, np.zeros(1)
    for _ in range(150):
        expected, added = moments.until(expected, few_ns)
        expected_costs = expected_costs + added
    expected, added = moments.until(expected, rest_ns)
    np.testing.assert_allclose(many.shares, expected.shares, rtol=1e-10)
    np.testing.assert_allclose(many.moments, expected.moments, rtol=1e-9, atol=1e-9 * many.moments.max())
    np.testing.assert_allclose(costs, expected_costs + added, rtol=1e-9)


def patterns(packets: int, longest: int, forced: int) -> dict[tuple[bool, ...], float]:
    """The probability of each pattern of losses of BURSTS with at most ``longest`` in 4.

    Each begins with ``forced`` deliveries, none or one.
    """
    chain = np.array([[0.7, 0.3], [0.4, 0.6]])
    lost = np.array([0.1, 0.9])
    found = {}
    for pattern in product([False, True], repeat=packets - forced):
        states, outcomes = np.eye(2)[0] @ (chain if forced else np.eye(2)), [False] * forced
        for is_lost in pattern:
            allowed = sum(outcomes[-3:]) < longest
            states = (states @ chain) * (lost * allowed if is_lost else 1 - lost * allowed)
            outcomes.append(is_lost)
        found[tuple(outcomes)] = float(states.sum())
    return {outcomes: share for outcomes, share in found.items() if share}


@pytest.mark.parametrize(
    ("mode", "sync"), [("model", "first_packet"), ("zoh", "first_packet"), ("model", "known_state")]
)
def test_the_mean_cost_is_that_of_all_patterns_of_simulated_runs(mode: str, sync: str) -> None:
    """With a delay, ticks that drift, and a horizon within a period: three slots."""
    constraint = {"kind": "at_most", "losses": 2, "window": 4}
    timing = {"mode": mode, "controller.rate_hz": 16.0, "horizon_s": 1.4}
    always = {"mansd": 5, "initial_sync": sync, "impairments": [{"kind": "delay", "delay_s": 0.03}]}
    network = {**always, "loss": BURSTS, "constraints": [constraint]}
    found = find_mean_cost(scenario(**timing, network=network)).with_guarantee
    mean, forced = 0.0, int(sync == "first_packet")
    for outcomes, share in patterns(5 + forced, 2, forced).items():
        lost = [number for number, is_lost in enumerate(outcomes) if is_lost]
        scripted = {**always, "loss": {"model": "scripted", "lost": lost}}
        run = scenario(**timing, network=scripted)
        mean += share * SampledWork(run, 0, None, None, 0.1, 10**6).run(range(1))["cost"][0]
    assert isinstance(found, CostUnder)
    assert found.horizon_cost == pytest.approx(mean, rel=1e-9)


def test_the_mean_cost_of_noisy_runs_is_that_of_a_campaign() -> None:
    """A campaign of 200 draws; by chance 5.5 standard errors are exceeded once in 10⁷."""
    given = scenario(**NOISE, network={"mansd": 2, "loss": BURSTS})
    Q, R = np.array([[2.0, 0.5], [0.5, 1.0]]), np.array([[0.3]])
    found = find_mean_cost(given, Q, R).with_guarantee
    costs = SampledWork(given, 3, Q, R, 0.1, 10**6).run(range(200))["cost"]
    assert isinstance(found, CostUnder)
    assert abs(costs.mean() - found.horizon_cost) < 5.5 * costs.std() / np.sqrt(len(costs))
    assert costs.std() / np.sqrt(len(costs)) < 0.05 * found.horizon_cost


def test_the_transient_and_the_stationary_part_are_limits() -> None:
    quiet = find_mean_cost(scenario(horizon_s=100.0, network={"mansd": 2, "loss": BURSTS})).with_guarantee
    noisy = [find_mean_cost(scenario(horizon_s=t_s, **NOISE)).with_guarantee for t_s in (99, 100)]
    assert isinstance(quiet, CostUnder)
    assert quiet.transient_cost == pytest.approx(quiet.horizon_cost, rel=1e-9)
    early, late = noisy
    assert isinstance(early, CostUnder)
    assert isinstance(late, CostUnder)
    assert late.horizon_cost is not None
    assert early.horizon_cost is not None
    assert late.horizon_cost - early.horizon_cost == pytest.approx(late.stationary.cost_per_s)


def test_costs_that_do_not_depend_on_what_grows_are_those_of_the_loop_without_it() -> None:
    """x_2 drives itself only, and nothing but the weight Q_22 depends on it."""

    def found(states: int, *weights: float) -> CostUnder:
        A, B, gain = np.diag([-1.0, 0.5]), np.array([[1.0], [0.0]]), np.array([[-2.0, 0.0]])
        model = {"A": A[:states, :states], "B": B[:states], "gain": gain[:, :states], "allow_unstable": True}
        plant = {"initial_state": [1.0, 0.3][:states], "rate_hz": 40.0,
                 "disturbances": [{"kind": "gaussian", "std": [0.1]}]}  # fmt: skip
        given = scenario(model={key: np.array(value).tolist() for key, value in model.items()}, plant=plant)
        cost = find_mean_cost(given, np.diag(weights)).with_guarantee
        assert isinstance(cost, CostUnder)
        return cost

    alone, beside, weighed = found(1, 1.0), found(2, 1.0, 0.0), found(2, 1.0, 1e-12)
    assert not alone.grows
    assert beside.growth == pytest.approx(np.exp(0.5 * 0.25))
    assert beside.stationary.state_rms == (pytest.approx(alone.stationary.state_rms[0]), None)
    assert beside.stationary.state_rms_at_transmissions[1] is None
    assert beside.stationary.input_rms == pytest.approx(alone.stationary.input_rms)
    assert beside.stationary.cost_per_s == pytest.approx(alone.stationary.cost_per_s)
    assert beside.transient_cost == pytest.approx(alone.transient_cost)
    assert (weighed.stationary.cost_per_s, weighed.transient_cost) == (None, None)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("words", "status", "message"),
    [
        (["lane_periodic"], 0, "0.862511"),
        (["lane_periodic", "--set", "network.mansd=20"], 1, "∞"),
        (["lane_periodic", "--set", "horizon_s=1e6"], 0, "not known"),
        (["lane_periodic", "--Q", "[0, 0, 0, 0]", "--R", "[0, 0]"], 2, "Q, R: all weights are 0"),
        (["lane_periodic", "--Q", "[1, 1]"], 2, "--Q [1, 1]: expected 4 x 4 numbers"),
        (["lane_periodic", "--Q", "[1, 1, 1, -1]"], 2, "Q: must be positive semidefinite"),
        (["lane_periodic", "--R", "[[1, 1], [0, 1]]"], 2, "R: must be symmetric"),
        (["lane_periodic", "--R", "[1e308, 1e308]"], 0, "0.862511"),
        (["lane_periodic", "--set", "trigger.period_s=1e6"], 1, "beyond 1e308"),
        (["lane_following"], 2, "trigger.policy"),
        (["pendulum_observed"], 2, "observer.kind"),
        (["lane_crosswind"], 2, "plant.disturbances"),
    ],
)
def test_noack_cost_prints_the_result_or_the_reason(words: list[str], status: int, message: str) -> None:
    done = invoke("cost", *words)
    assert done.exit_code == status, done.output
    assert message in done.output
