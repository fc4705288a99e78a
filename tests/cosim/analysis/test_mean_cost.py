"""Mean costs: closed forms, all patterns of losses, simulated runs, and the command."""

from itertools import product

import numpy as np
import pytest

from cosim.analysis.mean_cost import CostUnder, find_mean_cost
from cosim.studies.campaign.drawn_runs import SampledWork
from tests.helpers.command_line import invoke
from tests.noack.theory.random_losses.example_losses import BURSTS, NOISE, scenario


def test_a_held_integrator_with_independent_losses_by_hand() -> None:
    """x⁺ = x + T(u + d), u⁺ = K x⁺ or u⁺ = u: the equations for E x², E xu and E u² = K² E x²."""
    T, K, sigma, p = 0.5, -0.8, 0.3, 0.4
    model = {"A": [[0.0]], "B": [[1.0]], "gain": [[K]]}
    cost = find_mean_cost(
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
    assert isinstance(cost, CostUnder)
    assert cost.stationary.state_rms_at_transmissions == pytest.approx([a**0.5], rel=1e-9)
    assert cost.stationary.input_rms == pytest.approx([c**0.5], rel=1e-9)
    over_time = a + T * b + (T**2) * (c + sigma**2) / 3
    assert cost.stationary.cost_per_s == pytest.approx(over_time + c, rel=1e-9)


def patterns(packets: int, longest: int, forced: int) -> dict[tuple[bool, ...], float]:
    """The probability of each pattern of losses of BURSTS with at most ``longest`` in 4.

    Each begins with ``forced`` deliveries, none or one.
    """
    chain = np.array([[0.7, 0.3], [0.4, 0.6]])
    lost = np.array([0.1, 0.9])
    shares = {}
    for pattern in product([False, True], repeat=packets - forced):
        states, outcomes = np.eye(2)[0] @ (chain if forced else np.eye(2)), [False] * forced
        for is_lost in pattern:
            allowed = sum(outcomes[-3:]) < longest
            states = (states @ chain) * (lost * allowed if is_lost else 1 - lost * allowed)
            outcomes.append(is_lost)
        shares[tuple(outcomes)] = float(states.sum())
    return {outcomes: share for outcomes, share in shares.items() if share}


@pytest.mark.parametrize(
    ("mode", "sync", "delay_s"),
    [
        ("model", "first_packet", 0.03),
        ("zoh", "first_packet", 0.03),
        ("model", "known_state", 0.03),
        ("zoh", "first_packet", 0.53),
        ("model", "known_state", 0.28),
        ("model", "first_packet", 1.35),
    ],
)
def test_the_mean_cost_is_that_of_all_patterns_of_simulated_runs(
    mode: str, sync: str, delay_s: float
) -> None:
    """With a delay, also of several periods, ticks that drift, and a horizon within a period: three slots."""
    constraint = {"kind": "at_most", "losses": 2, "window": 4}
    timing = {"mode": mode, "controller.rate_hz": 16.0, "horizon_s": 1.4}
    always = {"mansd": 5, "initial_sync": sync, "impairments": [{"kind": "delay", "delay_s": delay_s}]}
    network = {**always, "loss": BURSTS, "constraints": [constraint]}
    cost = find_mean_cost(scenario(**timing, network=network)).with_guarantee
    mean, forced = 0.0, int(sync == "first_packet")
    for outcomes, share in patterns(5 + forced, 2, forced).items():
        lost = [number for number, is_lost in enumerate(outcomes) if is_lost]
        scripted = {**always, "loss": {"model": "scripted", "lost": lost}}
        run = scenario(**timing, network=scripted)
        mean += share * SampledWork(run, 0, None, None, 0.1, 10**6).run(range(1))["cost"][0]
    assert isinstance(cost, CostUnder)
    assert cost.horizon_cost == pytest.approx(mean, rel=1e-9)


def test_the_mean_cost_of_noisy_runs_is_that_of_a_campaign() -> None:
    """A campaign of 100 draws; by chance 5.5 standard errors are exceeded once in 10⁷."""
    lossy_scenario = scenario(**NOISE, network={"mansd": 2, "loss": BURSTS})
    Q, R = np.array([[2.0, 0.5], [0.5, 1.0]]), np.array([[0.3]])
    cost = find_mean_cost(lossy_scenario, Q, R).with_guarantee
    costs = SampledWork(lossy_scenario, 3, Q, R, 0.1, 10**6).run(range(100))["cost"]
    assert isinstance(cost, CostUnder)
    assert abs(costs.mean() - cost.horizon_cost) < 5.5 * costs.std() / np.sqrt(len(costs))
    assert costs.std() / np.sqrt(len(costs)) < 0.05 * cost.horizon_cost


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

    def stationary_cost(states: int, *weights: float) -> CostUnder:
        A, B, gain = np.diag([-1.0, 0.5]), np.array([[1.0], [0.0]]), np.array([[-2.0, 0.0]])
        model = {"A": A[:states, :states], "B": B[:states], "gain": gain[:, :states], "allow_unstable": True}
        plant = {"initial_state": [1.0, 0.3][:states], "rate_hz": 40.0,
                 "disturbances": [{"kind": "gaussian", "std": [0.1]}]}  # fmt: skip
        given = scenario(model={key: np.array(value).tolist() for key, value in model.items()}, plant=plant)
        cost = find_mean_cost(given, np.diag(weights)).with_guarantee
        assert isinstance(cost, CostUnder)
        return cost

    alone, beside, weighed = (
        stationary_cost(1, 1.0),
        stationary_cost(2, 1.0, 0.0),
        stationary_cost(2, 1.0, 1e-12),
    )
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
        (["lane_periodic", "--Q", "[1, 1]"], 2, "Q [1, 1]: expected 4 x 4 numbers"),
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
    result = invoke("cost", *words)
    assert result.exit_code == status, result.output
    assert message in result.output
