"""Runs under other policies than the paper's, one after the other, by the exact simulator.

Events are exact, as everywhere. The cost is integrated by Gauss's rule between events, to some
1e-10 of it; where ‖e_c‖ is largest and when ‖x‖ has settled is looked up every 10 ms and at events.
"""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from cosim.batch.api import ROW, Population, Setting
from cosim.batch.status import DIVERGED, OK, TOO_MANY_EVENTS
from cosim.exact.loop import ContinuousLoop
from cosim.exact.run import ContinuousRun, TooManyEventsError, simulate_continuous
from netem.link import UPDATE_LINK, Link
from noack.impairments import LinkSettings
from noack.linear import Matrix, Vector
from noack.records import Fate
from noack.resolve import Loop

_STEP_S = 0.01
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)


def run_others(setting: Setting, population: Population) -> NDArray[np.void]:
    """Run every draw; one row of :data:`cosim.batch.api.ROW` each, (k,)."""
    rows = np.zeros(len(population.x0), ROW)
    for i, draw in enumerate(zip(*population, strict=True)):
        rows[i] = _row(setting, *draw)
    return rows


def _row(setting: Setting, A: Matrix, B: Matrix, x0: Vector, seed: np.uint64) -> tuple[float, ...]:
    trigger = setting.trigger
    loop = Loop(A, B, setting.K, setting.H, A, B, x0, trigger.weight, (), ())
    try:
        run = simulate_continuous(
            ContinuousLoop(loop, trigger),
            horizon_s=setting.horizon_s,
            delivered=_fates(setting.link, int(seed)),
            known_start=setting.known_start,
            max_events=setting.most_events,
        )
    except TooManyEventsError:
        unknown = (math.nan,) * 7
        return (setting.most_events, 0, *unknown, TOO_MANY_EVENTS)
    gaps_s, finished = np.diff(run.event_s), run.diverged_at_s is None
    return (
        len(run.event_s),
        int(run.delivered.sum()),
        float(gaps_s.min()) if len(gaps_s) else math.nan,
        float(gaps_s.mean()) if len(gaps_s) else math.nan,
        *(_measures(setting, run) if finished else (math.nan,) * 4),
        math.nan if run.diverged_at_s is None else run.diverged_at_s,
        OK if finished else DIVERGED,
    )


def _measures(setting: Setting, run: ContinuousRun) -> tuple[float, float, float, float]:
    """Settling time, cost, largest ‖W e_c‖, and ‖x‖ at the end."""
    steps = max(round(setting.horizon_s / _STEP_S), 1)
    samples = run.at(np.linspace(0.0, setting.horizon_s, steps + 1))
    norms = np.linalg.norm(samples.x, axis=1)
    above = np.flatnonzero(norms > setting.settle * norms[0])
    settling_s = 0.0 if not len(above) else math.nan
    if len(above) and above[-1] < steps:
        settling_s = float(samples.t_s[above[-1] + 1])
    common = samples.t_s >= (0.0 if setting.known_start or not len(run.event_s) else run.event_s[0])
    before = np.array([state.e_c for state in run.before[0 if setting.known_start else 1 :]])
    at_events = run.system.norms(before.reshape(-1, run.system.loop.n))
    errors = np.concatenate([run.e_c_norm(samples)[common], at_events])
    return settling_s, _cost(setting, run), float(errors.max(initial=0.0)), float(norms[-1])


def _cost(setting: Setting, run: ContinuousRun) -> float:
    n, m = run.system.loop.n, run.system.loop.m
    Q = np.eye(n) if setting.Q is None else setting.Q
    R = np.eye(m) if setting.R is None else setting.R
    cost, ends_s = 0.0, [*run.event_s, setting.horizon_s]
    for state, end_s in zip((run.start, *run.after), ends_s, strict=True):
        span_s = end_s - state.t_s
        if span_s <= 0:
            continue
        parts = max(math.ceil(span_s / run.system.flow.width_s), 1)
        begins_s = state.t_s + span_s / parts * np.arange(parts)
        half_s = span_s / parts / 2
        t_s = (begins_s[:, None] + half_s * (1 + _NODES)).ravel()
        samples = run.system.sample(state, t_s)
        u = samples.x_c @ setting.K.T
        rate = ((samples.x @ Q) * samples.x).sum(axis=1) + ((u @ R) * u).sum(axis=1)
        cost += float(half_s * (np.tile(_WEIGHTS, parts) @ rate))
    return cost


def _fates(settings: LinkSettings, seed: int) -> Callable[[int], bool]:
    link = Link(settings, seed, UPDATE_LINK)
    return lambda event: Fate(link.decide(0, 1, 0).fate).effective
