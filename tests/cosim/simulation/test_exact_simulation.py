"""Batches under every policy against single runs, whose events an integrator confirms."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cosim.simulation.continuous import TooManyEventsError, run_continuous
from cosim.simulation.exact_simulation import TOO_MANY_EVENTS, Population, Setting, run_batch, setting_of
from netem.core.errors import CallerError
from netem.impairments.kinds.delay import Delay
from netem.impairments.link_settings import LinkSettings
from noack.core.linear_systems import Matrix
from noack.scenario.resolution import loop_of
from noack.trigger_policies.trigger_rule import TriggerRule
from tests.cosim.simulation.exact_populations import (
    check_events,
    check_independence,
    compare,
    events_of,
    random_population,
    random_setting,
    reference,
    single,
)
from tests.helpers.example_rules import TABLES, decaying_rule, mixed_rule, quadratic_rule, random_rule
from tests.helpers.shipped import resolved

MS = 10**6
SIZES = ((4, 2), (2, 1))
"""Numbers of states and inputs."""
MOST_EVENTS = 500


def settings(name: str, seeds: range) -> list[tuple[Setting, Population]]:
    """Random settings under a policy, with two draws each."""
    simulations = []
    for seed in seeds:
        rng = np.random.default_rng([seed, *name.encode()])
        n, m = SIZES[seed % 2]
        setting = random_setting(rng, n, m)
        policy = random_rule(name, rng, n, setting.trigger.weight)
        if name == "lyapunov":  # After a lost update, the next event follows at once.
            setting = replace(setting, link=LinkSettings(), H=0.3 * setting.H - 0.7 * np.eye(n))
        population = random_population(rng, setting, 2)
        simulations.append((replace(setting, trigger=policy, most_events=MOST_EVENTS), population))
    return simulations


@pytest.mark.parametrize("name", TABLES)
def test_events_fates_and_measures_are_those_of_the_exact_simulator(name: str) -> None:
    events = finished = 0
    for setting, population in settings(
        name, range({"lyapunov": 12, "decaying": 8, "dynamic": 8}.get(name, 4))
    ):
        for i, row in enumerate(run_batch(setting, population)):
            draw = single(population, i)
            try:
                run = reference(setting, draw, MOST_EVENTS)
            except TooManyEventsError:
                assert row["status"] == TOO_MANY_EVENTS
                continue
            compare(setting, row, events_of(setting, draw), run)
            if i == 0 and events < 30:
                check_events(run, setting)
            events += len(run.event_s)
            finished += 1
    assert events > (2 if name == "lyapunov" else 15)
    assert finished >= (2 if name == "lyapunov" else 6)


@pytest.mark.parametrize("name", ["decaying", "mixed", "dynamic", "quadratic", "dwell of lyapunov"])
def test_a_row_depends_only_on_its_own_draw(name: str) -> None:
    rng = np.random.default_rng(5)
    for setting, _ in settings(name, range(2)):
        check_independence(setting, random_population(rng, setting, 8), rng.permutation(8))


def turning(sigma: float, omega: float, alpha: float) -> tuple[Setting, Population]:
    """‖x‖ = e^{−αt}, ‖e_s‖ = 2 e^{−αt} sin(ωt/2): the relative rule is met when sin(ωt/2) > σ/2."""
    turn = omega * np.array([[0.0, 1.0], [-1.0, 0.0]])
    horizon_s = 1.5 * math.pi / omega
    setting = known_loop(-alpha * np.eye(2), mixed_rule(sigma), horizon_s)
    return setting, draw_of(turn - alpha * np.eye(2))


def known_loop(H: Matrix, trigger: TriggerRule, horizon_s: float, **more: Any) -> Setting:
    """A loop without feedback and losses, from a known state."""
    return Setting(
        H=H, K=np.zeros((len(H) // 2, len(H))), trigger=trigger, link=LinkSettings(),
        horizon_s=horizon_s, known_start=True, **more,
    )  # fmt: skip


def draw_of(A: Matrix) -> Population:
    """A plant with ‖x(0)‖ = 1."""
    n = len(A)
    start = np.array([[0.6, 0.8, *[0.0] * (n - 2)]])
    return Population(A[None], np.ones((1, n, n // 2)), start, np.zeros(1, np.uint64))


@pytest.mark.parametrize("alpha_omega", [0.1, 70.0])
@pytest.mark.parametrize("omega", [0.3, 200.0])
@pytest.mark.parametrize("depth", [1e-2, 1e-11])
def test_very_short_crossings_are_found(depth: float, omega: float, alpha_omega: float) -> None:
    """Also where the state has decayed to e^{−70π}, 1e-95.

    Each of the hundred polynomials up to there adds a relative error of about 1e-14.
    """
    batch_events = events_of(*turning(2 * (1 - depth), omega, alpha_omega * omega))
    first_s = 2 / omega * math.asin(1 - depth)
    tolerance_s = 5e-13 / math.sqrt(depth) / omega + 1e-12 * first_s
    assert batch_events.event_s[0] == pytest.approx(first_s, abs=tolerance_s)
    beyond = turning(2 * (1 + depth), omega, alpha_omega * omega)
    assert events_of(*beyond).event_s.size == 0


@pytest.mark.parametrize("mode", ["model", "zoh"])
def test_a_batch_setting_of_a_scenario_gives_the_scenarios_run(mode: str) -> None:
    seed = 2**40 + 3
    settings = [f"mode={mode}", "horizon_s=8", f"seeds.loss={seed}"]
    scenario = resolved("lane_following", *settings)
    loop = loop_of(scenario)
    draw = Population(loop.A[None], loop.B[None], loop.x0[None], np.array([seed], np.uint64))
    batch_events = events_of(setting_of(scenario), draw)
    run = run_continuous(scenario)
    assert len(run.event_s) >= (1 if mode == "model" else 5)
    np.testing.assert_allclose(batch_events.event_s, run.event_s, rtol=0, atol=1e-9)
    assert batch_events.delivered.tolist() == run.delivered.tolist()


def test_invalid_settings_are_refused() -> None:
    rng = np.random.default_rng(1)
    setting = random_setting(rng, 2, 1)
    population = random_population(rng, setting, 3)
    with pytest.raises(ValueError, match="x0: expected the shape"):
        run_batch(setting, population._replace(x0=population.x0[:, :1]))
    with pytest.raises(ValueError, match="loss_seeds: expected uint64"):
        run_batch(setting, population._replace(loss_seeds=np.zeros(3, np.int64)))  # type: ignore[arg-type]
    delayed_link = setting.link.model_copy(update={"impairments": (Delay(delay_s=1.0),)})
    with pytest.raises(CallerError, match="losses and corruption only"):
        run_batch(Setting(**{**vars(setting), "link": delayed_link}), population)
    with pytest.raises(CallerError, match=r"trigger\.floor"):
        run_batch(
            Setting(**{**vars(setting), "trigger": decaying_rule(1.0, 1.0), "horizon_s": 1e3}),
            population,
        )
    wide = quadratic_rule(np.eye(6), 10**6)
    with pytest.raises(ValueError, match="trigger: expected 4 columns, found 6"):
        run_batch(Setting(**{**vars(setting), "trigger": wide}), population)
