"""Batches against the exact simulator, whose method is another one, on the same draws."""

import json
import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from cosim.batch.api import (
    Population,
    Setting,
    run_batch,
    run_events,
    setting_of,
)
from cosim.batch.status import DIVERGED, OK, TOO_MANY_EVENTS
from cosim.exact.fates import network_fates
from cosim.exact.loop import continuous_loop_of
from cosim.exact.run import ContinuousRun, simulate_continuous
from netem.link import UPDATE_LINK, Link
from noack.errors import CallerError
from noack.impairments import (
    Bernoulli,
    Corrupt,
    Delay,
    FourState,
    GilbertElliott,
    LinkSettings,
    Lossless,
    LossOf,
    Periodic,
    Scripted,
    WorstCase,
)
from noack.linear import Vector
from noack.records import Fate
from noack.resolve import Loop, loop_of, resolve
from noack.scenario import Scenario
from noack.trigger.decaying import DecayingTrigger

LOSSES = (
    Lossless(),
    Bernoulli(probability=0.7),
    Bernoulli(probability=0.5, correlation=0.8),
    GilbertElliott(good_to_bad=0.4, bad_to_good=0.3, loss_in_good=0.1, loss_in_bad=0.9),
    FourState(p13=0.4, p31=0.3, p32=0.4, p23=0.5, p14=0.1),
    Periodic(period=5, burst=3, first=1),
    Scripted(lost=(1, 2, 5, 6, 7), repeat_every=9),
    WorstCase(),
)
SIZES = ((2, 1), (4, 2))


def random_setting(rng: np.random.Generator, n: int, m: int) -> Setting:
    """Any mode, weight, floor, cap, loss and start; cost weights half of the time."""
    known, held, floor = rng.random(3) < 0.5
    impairments: list[Any] = [LossOf(loss=LOSSES[rng.integers(len(LOSSES))])]
    if rng.random() < 0.3:
        impairments.append(Corrupt(probability=0.3))
    if rng.random() < 0.2:
        impairments.append(LossOf(loss=Bernoulli(probability=0.2)))
    weight = np.eye(n) + 0.5 * rng.uniform(-1, 1, (n, n)) if rng.random() < 0.5 else None
    Q, R = (part @ part.T for part in (rng.uniform(-1, 1, (n, n)), rng.uniform(-1, 1, (m, m))))
    weighs = rng.random() < 0.5
    return Setting(
        H=np.zeros((n, n)) if held else rng.uniform(-1, 1, (n, n)) * 2 / math.sqrt(n) - np.eye(n),
        K=rng.uniform(-1, 1, (m, n)) * 2 / math.sqrt(n),
        trigger=DecayingTrigger(0.3, rng.choice([0.1, 1.0]), 0.1 if floor else 0.0, weight),
        link=LinkSettings(
            impairments=tuple(impairments),
            mansd=int(rng.integers(0, 5)) if rng.random() < 0.9 else None,
            first_delivered=bool(not known and rng.random() < 0.8),
        ),
        horizon_s=3.0,
        known_start=bool(known),
        Q=Q if weighs else None,
        R=R if weighs else None,
        settle=0.3,
        most_events=2000,
    )


def random_population(rng: np.random.Generator, setting: Setting, k: int) -> Population:
    """Plants whose closed loop is anything from the model's own to another one altogether."""
    n, m = len(setting.H), len(setting.K)
    B = rng.uniform(-1, 1, (k, n, m)) * 2 / math.sqrt(n)
    apart = rng.choice([0.0, 1e-6, 0.3, 1.0], (k, 1, 1)) * rng.uniform(-1, 1, (k, n, n))
    A = setting.H - B @ setting.K + apart
    seeds = rng.integers(0, 2**64, k, dtype=np.uint64)
    return Population(A, B, rng.uniform(-1, 1, (k, n)), seeds)


def one(population: Population, i: int) -> Population:
    return Population(*(part[i : i + 1] for part in population))


def reference(setting: Setting, draw: Population, most_events: int = 2000) -> ContinuousRun:
    """The exact simulator's run of a population of one."""
    (A,), (B,), (x0,), (seed,) = draw
    n, m = B.shape
    names = tuple(f"x_{i}" for i in range(n))
    loop = Loop(
        A, B, setting.K, setting.H, A, B, x0, setting.trigger.weight, names, names[:m] or names
    )
    link, known = Link(setting.link, int(seed), UPDATE_LINK), []

    def delivered(event: int) -> bool:
        assert event == len(known)
        known.append(Fate(link.decide(0, 1, 0).fate).effective)
        return known[-1]

    return simulate_continuous(
        loop,
        setting.trigger,
        horizon_s=setting.horizon_s,
        delivered=delivered,
        known_start=setting.known_start,
        max_events=most_events,
    )


def pieces(run: ContinuousRun) -> list[tuple[Any, float, float]]:
    """State after the last event, from when, and until when."""
    spans_s = pairwise([0.0, *run.event_s, run.reached_s])
    found = zip((run.start, *run.after), spans_s, strict=True)
    return [(state, begin_s, end_s) for state, (begin_s, end_s) in found if end_s > begin_s]


def cost_of(run: ContinuousRun, setting: Setting) -> float:
    """By Gauss's rule with 24 nodes on parts of 0.1 s at most."""
    n, m = len(setting.H), len(setting.K)
    Q = np.eye(n) if setting.Q is None else setting.Q
    R = np.eye(m) if setting.R is None else setting.R
    nodes, weights = np.polynomial.legendre.leggauss(24)
    total = 0.0
    for state, begin_s, end_s in pieces(run):
        edges_s = np.linspace(begin_s, end_s, math.ceil((end_s - begin_s) / 0.1) + 1)
        for low_s, high_s in pairwise(edges_s):
            t_s = low_s + (high_s - low_s) * (nodes + 1) / 2
            samples = run.system.sample(state, t_s)
            u = samples.x_c @ setting.K.T
            integrand = ((samples.x @ Q) * samples.x).sum(1) + ((u @ R) * u).sum(1)
            total += (high_s - low_s) / 2 * float(weights @ integrand)
    return total


def dense(run: ContinuousRun, setting: Setting) -> tuple[Vector, Vector, Vector]:
    """Times, ‖x‖ and ‖W e_c‖ e^{αt} from just after an event to just before the next."""
    alpha = setting.trigger.alpha_per_s
    times_s, norms, errors = [], [], []
    for state, begin_s, end_s in pieces(run):
        t_s = np.linspace(begin_s, end_s, 400)
        samples = run.system.sample(state, t_s)
        times_s.append(t_s)
        norms.append(np.linalg.norm(samples.x, axis=1))
        errors.append(run.e_c_norm(samples) * np.exp(alpha * t_s))
    return np.concatenate(times_s), np.concatenate(norms), np.concatenate(errors)


@pytest.mark.parametrize("size", SIZES)
def test_events_fates_and_measures_are_those_of_the_exact_simulator(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(size[0])
    events = lost = settled = 0
    for _ in range(15):
        setting = random_setting(rng, *size)
        population = random_population(rng, setting, 4)
        rows = run_batch(setting, population)
        for i, row in enumerate(rows):
            run = reference(setting, one(population, i))
            found = run_events(setting, one(population, i))
            assert row["status"] == OK
            assert found.delivered.tolist() == run.delivered.tolist()
            np.testing.assert_allclose(found.event_s, run.event_s, rtol=0, atol=1e-9)
            assert row["transmissions"] == len(run.event_s)
            assert row["deliveries"] == run.delivered.sum()
            gaps_s = np.diff(run.event_s)
            if len(gaps_s):
                assert row["inter_event_min_s"] == pytest.approx(gaps_s.min(), abs=2e-9)
                assert row["inter_event_mean_s"] == pytest.approx(gaps_s.mean(), abs=2e-9)
            else:
                assert math.isnan(row["inter_event_min_s"])
                assert math.isnan(row["inter_event_mean_s"])
            assert row["cost"] == pytest.approx(cost_of(run, setting), rel=1e-9, abs=1e-15)
            t_s, norms, errors = dense(run, setting)
            assert row["final_norm"] == pytest.approx(norms[-1], rel=1e-9)
            assert errors.max() <= row["sup_e_c_scaled"] * (1 + 1e-9) + 1e-15
            assert row["sup_e_c_scaled"] <= errors.max() * (1 + 1e-3) + 1e-15
            above = np.flatnonzero(norms > setting.settle * norms[0])
            if above[-1] == len(norms) - 1:
                assert math.isnan(row["settling_s"])
            else:
                settled += 1
                low_s, high_s = t_s[above[-1]], t_s[above[-1] + 1]
                assert low_s - 1e-12 <= row["settling_s"] <= high_s + 1e-12
            assert math.isnan(row["diverged_at_s"])
            events += len(run.event_s)
            lost += int((~run.delivered).sum())
    assert events > 300
    assert lost > 50
    assert settled > 3


def scenario(content: dict[str, Any], **changes: Any) -> Scenario:
    return resolve(Scenario.model_validate_json(json.dumps(content | changes)))


@pytest.mark.parametrize("mode", ["model", "zoh"])
def test_a_setting_of_a_scenario_runs_as_the_scenario(content: dict[str, Any], mode: str) -> None:
    content["network"]["impairments"] = [{"kind": "delay", "delay_s": 0.1}]
    resolved = scenario(content, mode=mode, horizon_s=8.0, seeds={"loss": 2**40 + 3})
    loop = loop_of(resolved)
    draw = Population(loop.A[None], loop.B[None], loop.x0[None], np.array([2**40 + 3], np.uint64))
    found = run_events(setting_of(resolved), draw)
    run = simulate_continuous(
        continuous_loop_of(resolved), horizon_s=8.0, delivered=network_fates(resolved),
        known_start=False,
    )  # fmt: skip
    assert len(run.event_s) >= (1 if mode == "model" else 5)
    np.testing.assert_allclose(found.event_s, run.event_s, rtol=0, atol=1e-9)
    assert found.delivered.tolist() == run.delivered.tolist()


def test_a_row_depends_on_its_own_draw_only() -> None:
    rng = np.random.default_rng(7)
    for _ in range(5):
        setting = random_setting(rng, 3, 2)
        population = random_population(rng, setting, 40)
        rows = run_batch(setting, population)
        order = rng.permutation(40)
        mixed = run_batch(setting, Population(*(part[order] for part in population)))
        assert mixed.tobytes() == rows[order].tobytes()
        alone = np.concatenate([run_batch(setting, one(population, i)) for i in range(40)])
        assert alone.tobytes() == rows.tobytes()


def turning(depth: float, omega: float, floored: bool) -> tuple[Setting, Population, float]:
    """‖e_s‖ over the threshold is sin(ωt/2)/(1 − depth): it pokes through around t = π/ω."""
    alpha = 0.0 if floored else 0.8
    turn = np.array([[0.0, omega], [-omega, 0.0]])
    level = 2.0 * math.hypot(0.3, 0.4) * (1 - depth)
    trigger = DecayingTrigger(level * 1e-3, 0.8, level) if floored else DecayingTrigger(level, 0.8)
    setting = Setting(
        H=-alpha * np.eye(2), K=np.zeros((1, 2)), trigger=trigger, link=LinkSettings(),
        horizon_s=1.5 * math.pi / omega, known_start=True,
    )  # fmt: skip
    draw = Population(
        (turn - alpha * np.eye(2))[None], np.ones((1, 2, 1)), np.array([[0.3, 0.4]]),
        np.zeros(1, np.uint64),
    )  # fmt: skip
    return setting, draw, 2 / omega * math.asin(min(1 - depth, 1.0))


@pytest.mark.parametrize("floored", [False, True])
@pytest.mark.parametrize("omega", [0.3, 7.0, 200.0])
@pytest.mark.parametrize("depth", [1e-2, 1e-5, 1e-7, 1e-9, 1e-12])
def test_a_crossing_however_short_is_found(depth: float, omega: float, floored: bool) -> None:
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


def test_a_loop_that_diverges_says_so() -> None:
    one_ = np.ones((1, 1))
    setting = Setting(
        H=100 * one_, K=0 * one_, trigger=DecayingTrigger(0.5, 0.25), link=LinkSettings(),
        horizon_s=50.0, known_start=True,
    )  # fmt: skip
    draw = Population(100 * one_[None], one_[None], np.ones((1, 1)), np.zeros(1, np.uint64))
    (row,) = run_batch(setting, draw)
    assert row["status"] == DIVERGED
    assert row["transmissions"] == 0
    assert 0 <= row["diverged_at_s"] - math.log(1e100) / 100 <= 0.2
    for name in ("cost", "settling_s", "final_norm", "sup_e_c_scaled"):
        assert math.isnan(row[name])


def test_events_of_unstable_loops_are_those_of_the_exact_simulator_while_they_can_be_told() -> None:
    """x grows and the threshold falls: after a while there are too many events."""
    rng = np.random.default_rng(3)
    compared = 0
    for _ in range(10):
        setting = random_setting(rng, 2, 1)
        population = random_population(rng, setting, 1)
        wild = population._replace(A=population.A + 2 * np.eye(2))
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


def test_mistakes_are_told() -> None:
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
            Setting(**{**vars(setting), "trigger": DecayingTrigger(1.0, 1.0), "horizon_s": 1e3}),
            population,
        )
