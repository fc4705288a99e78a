"""Batches under the paper's policy against the exact simulator, on the same draws."""

import math

import numpy as np
import pytest

from cosim.shipped_files import find_shipped
from cosim.simulation.batch import (
    Population,
    Setting,
    run_batch,
    run_events,
    setting_of,
)
from cosim.simulation.continuous import run_continuous
from cosim.simulation.exact_simulation import DIVERGED, OK, TOO_MANY_EVENTS
from noack.config.resolution import loop_of, resolve
from noack.config.scenario_file import load
from noack.core.errors import CallerError
from noack.impairments.kinds.delay import Delay
from noack.impairments.link_settings import LinkSettings
from tests.cosim.simulation.batch.exact import (
    check_events,
    check_independence,
    compare,
    one,
    random_population,
    random_setting,
    reference,
)
from tests.trigger_rules import decaying_rule, quadratic_rule

SIZE = (4, 2)
"""States and inputs of most campaigns of the tests: each size is compiled anew."""


def test_events_fates_and_measures_are_those_of_the_exact_simulator() -> None:
    rng = np.random.default_rng(4)
    events = lost = settled = checked = 0
    for _ in range(15):
        setting = random_setting(rng, *SIZE)
        population = random_population(rng, setting, 2)
        for i, row in enumerate(run_batch(setting, population)):
            run = reference(setting, one(population, i))
            compare(setting, row, run_events(setting, one(population, i)), run)
            if i == 0:
                checked += check_events(run, setting)
            events += len(run.event_s)
            lost += int((~run.delivered).sum())
            settled += not math.isnan(row["settling_s"])
    assert events > 150
    assert checked > 50
    assert lost > 30
    assert settled > 1


@pytest.mark.parametrize("mode", ["model", "zoh"])
def test_a_batch_setting_of_a_scenario_gives_the_scenarios_run(mode: str) -> None:
    seed, delay = 2**40 + 3, 'network.impairments=[{kind="delay", delay_s=0.1}]'
    settings = [f"mode={mode}", "horizon_s=8", f"seeds.loss={seed}", delay]
    resolved = resolve(load(find_shipped("lane_following", "scenarios"), settings))
    loop = loop_of(resolved)
    draw = Population(loop.A[None], loop.B[None], loop.x0[None], np.array([seed], np.uint64))
    found = run_events(setting_of(resolved), draw)
    run = run_continuous(resolved)
    assert len(run.event_s) >= (1 if mode == "model" else 5)
    np.testing.assert_allclose(found.event_s, run.event_s, rtol=0, atol=1e-9)
    assert found.delivered.tolist() == run.delivered.tolist()


def test_a_row_depends_only_on_its_own_draw() -> None:
    rng = np.random.default_rng(7)
    for _ in range(4):
        setting = random_setting(rng, *SIZE)
        check_independence(setting, random_population(rng, setting, 10), rng.permutation(10))


def turning(depth: float, omega: float, floored: bool) -> tuple[Setting, Population, float]:
    """‖e_s‖ over the threshold is sin(ωt/2)/(1 − depth): it exceeds 1 briefly around t = π/ω."""
    alpha = 0.0 if floored else 0.8
    turn = np.zeros((4, 4))
    turn[0, 1], turn[1, 0] = omega, -omega
    level = 2.0 * math.hypot(0.3, 0.4) * (1 - depth)
    trigger = decaying_rule(level * 1e-3 if floored else level, 0.8, level if floored else 0.0, n=4)
    setting = Setting(
        H=-alpha * np.eye(4), K=np.zeros((2, 4)), trigger=trigger, link=LinkSettings(),
        horizon_s=1.5 * math.pi / omega, known_start=True,
    )  # fmt: skip
    draw = Population(
        (turn - alpha * np.eye(4))[None], np.ones((1, 4, 2)), np.array([[0.3, 0.4, 0, 0]]),
        np.zeros(1, np.uint64),
    )  # fmt: skip
    return setting, draw, 2 / omega * math.asin(min(1 - depth, 1.0))


@pytest.mark.parametrize("floored", [False, True])
@pytest.mark.parametrize("omega", [0.3, 200.0])
@pytest.mark.parametrize("depth", [1e-2, 1e-7, 1e-12])
def test_very_short_crossings_are_found(depth: float, omega: float, floored: bool) -> None:
    setting, draw, first_s = turning(depth, omega, floored)
    found = run_events(setting, draw)
    tolerance_s = 2e-14 / math.sqrt(depth) / omega + 1e-12 * first_s
    assert found.event_s[0] == pytest.approx(first_s, abs=tolerance_s)
    assert run_events(*turning(-depth, omega, floored)[:2]).event_s.size == 0


def test_the_supremum_between_events_is_certified() -> None:
    """e_c = e_s turns with x, and nothing is sent: sup ‖e_c‖ e^{αt} is 2‖x(0)‖, at π/ω."""
    for omega in (0.3, 7.0, 200.0):
        setting, draw, _ = turning(-1e-3, omega, False)
        (row,) = run_batch(setting, draw)
        assert row["transmissions"] == 0
        assert 1 - 1e-10 <= row["sup_e_c_scaled"] / 1.0 <= 1 + 1e-12


def test_a_diverging_loop_is_reported() -> None:
    fast = 100 * np.eye(4)
    setting = Setting(
        H=fast, K=np.zeros((2, 4)), trigger=decaying_rule(0.5, 0.25, n=4), link=LinkSettings(),
        horizon_s=50.0, known_start=True,
    )  # fmt: skip
    start = np.array([[0.6, 0.8, 0.0, 0.0]])
    draw = Population(fast[None], np.ones((1, 4, 2)), start, np.zeros(1, np.uint64))
    (row,) = run_batch(setting, draw)
    assert row["status"] == DIVERGED
    assert row["transmissions"] == 0
    # e^{100t} = 1e100 · 0.5 e^{−0.25t}; ‖(x, e_s, e_c)‖ = |x|.
    expected_s = math.log(0.5e100) / 100.25
    assert row["diverged_at_s"] == pytest.approx(expected_s, rel=1e-12)
    for name in ("cost", "settling_s", "final_norm", "sup_e_c_scaled"):
        assert math.isnan(row[name])


def test_events_of_unstable_loops_agree_until_they_accumulate() -> None:
    """x grows and the threshold decays: after a while there are too many events."""
    rng = np.random.default_rng(3)
    compared = 0
    for _ in range(10):
        setting = random_setting(rng, *SIZE)
        population = random_population(rng, setting, 1)
        wild = population._replace(A=population.A + 2 * np.eye(4))
        short = Setting(**{**vars(setting), "horizon_s": 1.5, "most_events": 5000})
        found, run = run_events(short, wild), reference(short, wild, 5000)
        assert len(found.event_s) == len(run.event_s)
        np.testing.assert_allclose(found.event_s, run.event_s, rtol=0, atol=1e-9)
        compared += len(found.event_s)
        few = Setting(**{**vars(setting), "horizon_s": 50.0, "most_events": 60})
        (row,) = run_batch(few, wild)
        assert row["status"] in (OK, TOO_MANY_EVENTS)
        if row["status"] == TOO_MANY_EVENTS:
            assert row["transmissions"] == 60
            assert math.isnan(row["cost"])
    assert compared > 100


def test_invalid_settings_are_refused() -> None:
    rng = np.random.default_rng(1)
    setting = random_setting(rng, 2, 1)
    population = random_population(rng, setting, 3)
    with pytest.raises(ValueError, match="x0: expected the shape"):
        run_batch(setting, population._replace(x0=population.x0[:, :1]))
    with pytest.raises(ValueError, match="loss_seeds: expected uint64"):
        run_batch(setting, population._replace(loss_seeds=np.zeros(3, np.int64)))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="one run"):
        run_events(setting, population)
    late = setting.link.model_copy(update={"impairments": (Delay(delay_s=1.0),)})
    with pytest.raises(CallerError, match="losses and corruption only"):
        run_batch(Setting(**{**vars(setting), "link": late}), population)
    with pytest.raises(CallerError, match=r"trigger\.floor"):
        run_batch(
            Setting(**{**vars(setting), "trigger": decaying_rule(1.0, 1.0), "horizon_s": 1e3}),
            population,
        )
    wide = quadratic_rule(np.eye(6), 10**6)
    with pytest.raises(ValueError, match="trigger: expected 4 columns, found 6"):
        run_batch(Setting(**{**vars(setting), "trigger": wide}), population)
