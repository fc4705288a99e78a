"""Random batches, and their comparison with single runs, whose events an integrator confirms."""

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from cosim.simulation.continuous import ContinuousLoop, ContinuousRun, simulate_continuous
from cosim.simulation.exact_simulation import OK, Events, Population, Setting, run_batch, run_with_events
from netem.core.packet_rows import Fate
from netem.impairments.constraints.at_most import AtMost
from netem.impairments.kinds.corrupt import Corrupt
from netem.impairments.kinds.loss import LossOf
from netem.impairments.link_settings import LinkSettings
from netem.impairments.loss_models.bernoulli import BernoulliLoss
from netem.impairments.loss_models.four_state import FourStateLoss
from netem.impairments.loss_models.gilbert_elliott import GilbertElliottLoss
from netem.impairments.loss_models.lossless import NoLoss
from netem.impairments.loss_models.periodic_loss import PeriodicLoss
from netem.impairments.loss_models.scripted import ScriptedLoss
from netem.impairments.loss_models.worst_case import WorstCaseLoss
from noack.core.linear_systems import Matrix, Vector
from noack.machines.run_channel import UPDATE_LINK
from noack.scenario.resolution import LoopMatrices
from noack.trigger_policies.trigger_rule import QuadraticForm
from tests.helpers.example_rules import decaying_rule
from tests.netem.stepped_link import Link

LOSSES = (
    NoLoss(),
    BernoulliLoss(probability=0.7),
    BernoulliLoss(probability=0.5, correlation=0.8),
    GilbertElliottLoss(good_to_bad=0.4, bad_to_good=0.3, loss_in_good=0.1, loss_in_bad=0.9),
    FourStateLoss(p13=0.4, p31=0.3, p32=0.4, p23=0.5, p14=0.1),
    PeriodicLoss(period=5, burst=3, first=1),
    ScriptedLoss(lost=(1, 2, 5, 6, 7), repeat_every=9),
    WorstCaseLoss(),
)


def random_setting(rng: np.random.Generator, n: int, m: int) -> Setting:
    """Any mode, weight, floor, cap, loss and start; cost weights in half of the cases."""
    known, held, floor = rng.random(3) < 0.5
    impairments: list[Any] = [LossOf(loss=LOSSES[rng.integers(len(LOSSES))])]
    if rng.random() < 0.3:
        impairments.append(Corrupt(probability=0.3))
    if rng.random() < 0.2:
        impairments.append(LossOf(loss=BernoulliLoss(probability=0.2)))
    weight = np.eye(n) + 0.5 * rng.uniform(-1, 1, (n, n)) if rng.random() < 0.5 else None
    Q, R = (part @ part.T for part in (rng.uniform(-1, 1, (n, n)), rng.uniform(-1, 1, (m, m))))
    weighs = rng.random() < 0.5
    return Setting(
        H=np.zeros((n, n)) if held else rng.uniform(-1, 1, (n, n)) * 2 / math.sqrt(n) - np.eye(n),
        K=rng.uniform(-1, 1, (m, n)) * 2 / math.sqrt(n),
        trigger=decaying_rule(0.3, rng.choice([0.1, 1.0]), 0.1 if floor else 0.0, weight, n),
        link=LinkSettings(
            impairments=tuple(impairments),
            mansd=int(rng.integers(0, 5)) if rng.random() < 0.9 else None,
            constraints=(AtMost(losses=2, window=int(rng.integers(3, 8))),) if rng.random() < 0.3 else (),
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
    """Plants with a closed loop that ranges from the model's own to an unrelated one."""
    n, m = len(setting.H), len(setting.K)
    B = rng.uniform(-1, 1, (k, n, m)) * 2 / math.sqrt(n)
    apart = rng.choice([0.0, 1e-6, 0.3, 1.0], (k, 1, 1)) * rng.uniform(-1, 1, (k, n, n))
    A = setting.H - B @ setting.K + apart
    seeds = rng.integers(0, 2**64, k, dtype=np.uint64)
    return Population(A, B, rng.uniform(-1, 1, (k, n)), seeds)


def single(population: Population, i: int) -> Population:
    return Population(*(part[i : i + 1] for part in population))


def events_of(setting: Setting, draw: Population) -> Events:
    """The events of a population of one."""
    _, (events,) = run_with_events(setting, draw)
    return events


def reference(setting: Setting, draw: Population, most_events: int = 2000) -> ContinuousRun:
    """The exact simulator's run of a population of one."""
    (A,), (B,), (x0,), (seed,) = draw
    n, m = B.shape
    names = tuple(f"x_{i}" for i in range(n))
    loop = LoopMatrices(
        A, B, setting.K, setting.H, A, B, x0, setting.trigger.weight, names, names[:m] or names
    )
    link, known = Link(setting.link, int(seed), UPDATE_LINK), []

    def delivered(event: int) -> bool:
        assert event == len(known)
        known.append(Fate(link.decide(0, 1, 0).fate).effective)
        return known[-1]

    return simulate_continuous(
        ContinuousLoop(loop, setting.trigger),
        horizon_s=setting.horizon_s,
        delivered=delivered,
        known_start=setting.known_start,
        max_events=most_events,
    )


def generator_of(system: ContinuousLoop) -> Matrix:
    """G of dz/dt = G z, z = (x, e_s, e_c), per second."""
    loop, zero = system.loop, np.zeros_like(system.loop.H)
    BK = loop.B @ loop.K
    E = loop.A + BK - loop.H
    return np.block([[loop.A + BK, zero, BK], [-E, loop.H, -BK], [-E, zero, loop.H - BK]])


def check_events(run: ContinuousRun, setting: Setting) -> int:
    """Check each event with scipy's integrator, in the paper's coordinates; return their number.

    The first time at which the comparison holds is that of the event, to 1e-7 s: the integrator's
    error of 1e-12, amplified by a flat crossing.
    """
    n = len(setting.H)
    rule, G = setting.trigger, generator_of(run.system)
    eta = setting.trigger.initial_dynamic_variable
    checked = 0
    dynamic = rule.dynamic_variable
    for state, begin_s, end_s in pieces(run):
        level, since_s = rule.level, 0.0
        if rule.from_event:
            level, since_s = float(np.linalg.norm(rule.form.positive[:, :n] @ state.x)), begin_s

        def flow(t_s: float, y: Vector) -> Vector:
            rate = float(np.linalg.norm(rule.form.positive @ y[: 2 * n])) if rule.integrates else 0.0
            if dynamic is not None:
                rate = value_of(dynamic.gain, y[: 2 * n]) - dynamic.decay_per_s * y[-1]
            return np.append(G @ y[:-1], rate)

        def excess(t_s: float, y: Vector, level: float = level, since_s: float = since_s) -> float:
            right = max(level * math.exp(-rule.rate_per_s * (t_s - since_s)), rule.floor)
            if rule.integrates:
                return float(y[-1]) - right
            eta_now = 0.0 if dynamic is None else float(y[-1])
            return value_of(rule.form, y[: 2 * n]) - eta_now - right * right

        start = np.concatenate([*state[1:], [0.0 if rule.integrates else eta]])
        solved = solve_ivp(flow, (begin_s, end_s), start, "DOP853", rtol=1e-11, atol=1e-14, dense_output=True)
        from_s = begin_s + max(rule.idle_ns * 1e-9, 0.0)
        if len(rule.form.positive) and not rule.grid_ns and from_s < end_s - 1e-6:
            inside = np.linspace(from_s, end_s, 203)[1:-1]
            inside = inside[inside < end_s - 1e-7]
            assert max(map(excess, inside, solved.sol(inside).T)) <= 1e-8
            checked += 1
        eta = float(solved.y[-1, -1])
        compares = len(rule.form.positive) > 0 and not rule.grid_ns
        due = abs(end_s - begin_s - rule.longest_ns * 1e-9) < 1e-9
        if compares and end_s in run.event_s and not due and end_s > from_s + 1e-9:
            assert abs(excess(end_s, solved.y[:, -1])) <= 1e-7
    return checked


def value_of(form: QuadraticForm, z: Vector) -> float:
    """‖P z‖² − ‖N z‖²."""
    positive, negative = form.positive @ z, form.negative @ z
    return float(positive @ positive - negative @ negative)


def pieces(run: ContinuousRun) -> list[tuple[Any, float, float]]:
    """State after the last event, start time and end time of each piece."""
    spans_s = pairwise([0.0, *run.event_s, run.reached_s])
    segments = zip((run.start, *run.after), spans_s, strict=True)
    return [(state, begin_s, end_s) for state, (begin_s, end_s) in segments if end_s > begin_s]


def cost_of(run: ContinuousRun, setting: Setting) -> float:
    """The cost by Gauss's rule with 24 nodes on parts of at most 0.1 s."""
    n, m = len(setting.H), len(setting.K)
    Q = np.eye(n) if setting.Q is None else setting.Q
    R = np.eye(m) if setting.R is None else setting.R
    nodes, weights = np.polynomial.legendre.leggauss(24)
    total = 0.0
    for state, begin_s, end_s in pieces(run):
        edges_s = np.linspace(begin_s, end_s, math.ceil((end_s - begin_s) / 0.1) + 1)
        for low_s, high_s in pairwise(edges_s):
            t_s = low_s + (high_s - low_s) * (nodes + 1) / 2
            samples = run.system.follow(np.array([state.t_s]), np.array(state[1:])[None], t_s)
            u = samples.x_c @ setting.K.T
            integrand = ((samples.x @ Q) * samples.x).sum(1) + ((u @ R) * u).sum(1)
            total += (high_s - low_s) / 2 * float(weights @ integrand)
    return total


def dense(run: ContinuousRun, setting: Setting) -> tuple[Vector, Vector, Vector]:
    """Times, ‖x‖ and ‖W e_c‖ e^{αt} from just after an event to just before the next."""
    rule = setting.trigger
    alpha = 0.0 if rule.from_event else rule.rate_per_s
    times_s, norms, errors = [], [], []
    for state, begin_s, end_s in pieces(run):
        t_s = np.linspace(begin_s, end_s, 400)
        samples = run.system.follow(np.array([state.t_s]), np.array(state[1:])[None], t_s)
        times_s.append(t_s)
        norms.append(np.linalg.norm(samples.x, axis=1))
        errors.append(run.e_c_norm(samples) * np.exp(alpha * t_s))
    return np.concatenate(times_s), np.concatenate(norms), np.concatenate(errors)


def compare(setting: Setting, row: Any, events: Events, run: ContinuousRun) -> None:
    """Compare a run of a batch with the exact simulator's, which uses another method."""
    assert row["status"] == OK
    assert events.delivered.tolist() == run.delivered.tolist()
    np.testing.assert_allclose(events.event_s, run.event_s, rtol=0, atol=1e-9)
    assert row["transmissions"] == len(run.event_s)
    assert row["deliveries"] == run.delivered.sum()
    bursts = "".join("D" if delivered else "L" for delivered in run.delivered).split("D")
    assert row["longest_loss_burst"] == max(map(len, bursts))
    gaps_s = np.diff(run.event_s)
    least_s, mean_s = (gaps_s.min(), gaps_s.mean()) if len(gaps_s) else (math.nan, math.nan)
    assert row["inter_event_min_s"] == pytest.approx(least_s, abs=2e-9, nan_ok=True)
    assert row["inter_event_mean_s"] == pytest.approx(mean_s, abs=2e-9, nan_ok=True)
    assert row["cost"] == pytest.approx(cost_of(run, setting), rel=1e-9, abs=1e-15)
    t_s, norms, errors = dense(run, setting)
    assert row["final_norm"] == pytest.approx(norms[-1], rel=1e-9)
    assert errors.max() <= row["sup_e_c_scaled"] * (1 + 1e-9) + 1e-15
    assert row["sup_e_c_scaled"] <= errors.max() * (1 + 1e-3) + 1e-15
    assert math.isnan(row["diverged_at_s"])
    last = np.flatnonzero(norms > setting.settle * norms[0])[-1]
    if last == len(norms) - 1:
        assert math.isnan(row["settling_s"])
    else:
        assert t_s[last] - 1e-12 <= row["settling_s"] <= t_s[last + 1] + 1e-12


def check_independence(setting: Setting, population: Population, order: Any) -> None:
    """Check that a row is the same in a permuted batch and in a batch of one draw."""
    rows = run_batch(setting, population)
    permuted = run_batch(setting, Population(*(part[order] for part in population)))
    assert permuted.tobytes() == rows[order].tobytes()
    alone = [run_batch(setting, single(population, i)) for i in range(len(order))]
    assert np.concatenate(alone).tobytes() == rows.tobytes()
