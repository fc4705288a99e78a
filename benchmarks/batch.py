"""The batch engine compared with what a user would write, in runs per second on one core.

Three sides use the same draws of the lane example, with the same packet fates: the engine; scipy's
integrator with an event function, at rtol 1e-8; and numpy loops with exact steps of 1 ms. The
engine also measures each run (cost, settling time, supremum of the error); the others only find the
events. For policies other than the paper's, the engine is compared with the exact simulator, which
finds the same events by another method, in Python.
"""

import argparse
import json
import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Literal

# Set before numpy is imported, as the command line does: small matrices do not gain from threads.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from benchmarks._report import Benchmark, Goal, Peer, Row, median, say
from cosim.cli import find_scenario
from cosim.simulation.batch.batch_interface import (
    Population,
    Setting,
    run_batch,
    run_events,
    setting_of,
)
from cosim.simulation.continuous.continuous_loop import ContinuousLoop
from cosim.simulation.continuous.continuous_run import ContinuousRun, simulate_continuous
from cosim.simulation.continuous.network_fates import network_fates
from noack.config.feature_kinds import POLICIES
from noack.config.resolution import LoopMatrices, loop_of, resolve
from noack.config.scenario import Scenario
from noack.config.scenario_file import load
from noack.config.sections.run_sections import SeedsSection
from noack.core.linear_systems import Vector

Mode = Literal["model", "zoh"]
Method = Literal["RK45", "DOP853"]
METHODS: tuple[Method, ...] = ("RK45", "DOP853")
"""Methods of the integrator: its default, and the fastest at this accuracy."""

ROUNDS = 5
DRAWS = 200
"""Number of different plants and losses; a batch repeats them."""
_REPEATED = {"model": 40, "zoh": 8}
_INTEGRATED = {"model": 20, "zoh": 3}
"""Runs of the integrator in a round."""
_STEP_S = 1e-3
_FATES = 1000
_AGREEMENT_S = 1e-4
"""Accumulated effect of the integrator's errors of 1e-8 over hundreds of events."""
_GOALS = {"model": 20_000.0, "zoh": 3_000.0}
_SIMULATED = 10
"""Runs of the exact simulator in a round."""


def drawn(
    mode: Mode, trigger: Mapping[str, Any] | None = None
) -> tuple[Setting, Population, NDArray[np.bool_]]:
    """Return the draws, by default with the paper's trigger, and the fates of the first updates."""
    scenario = load(find_scenario("lane_following"), ()).model_copy(update={"mode": mode})
    if trigger is not None:
        content = scenario.model_dump(mode="json") | {"trigger": trigger}
        scenario = Scenario.model_validate_json(json.dumps(content))

    def draw(i: int) -> Scenario:
        return resolve(scenario.model_copy(update={"seeds": SeedsSection(plant=i, loss=i)}))

    resolved = [draw(i) for i in range(DRAWS)]
    loops = [loop_of(one) for one in resolved]
    population = Population(
        np.array([loop.A for loop in loops]),
        np.array([loop.B for loop in loops]),
        np.array([loop.x0 for loop in loops]),
        np.arange(DRAWS, dtype=np.uint64),
    )
    fates = [[fate(k) for k in range(_FATES)] for fate in map(network_fates, resolved)]
    return setting_of(resolved[0]), population, np.array(fates)


def integrated(
    setting: Setting, draw: Population, delivered: NDArray[np.bool_], method: Method,
    rtol: float = 1e-8,
) -> list[float]:  # fmt: skip
    """Return event times by ``solve_ivp`` of plant and both models, from crossing to crossing."""
    A, B, x = draw.A[0], draw.B[0], draw.x0[0]
    n, trigger = len(x), setting.trigger
    field = np.zeros((3 * n, 3 * n))
    field[:n, :n], field[:n, 2 * n :] = A, B @ setting.K
    field[n : 2 * n, n : 2 * n] = field[2 * n :, 2 * n :] = setting.H

    def excess(t_s: float, z: Vector) -> float:
        error = float(np.linalg.norm(z[n : 2 * n] - z[:n]))
        return error - trigger.beta * float(np.exp(-trigger.alpha_per_s * t_s))

    excess.terminal, excess.direction = True, 1.0  # type: ignore[attr-defined]
    t_s, z, found = 0.0, np.concatenate([x, x, x]), [0.0]
    while True:
        solution = solve_ivp(
            lambda _, z: field @ z, (t_s, setting.horizon_s), z,
            method=method, events=excess, rtol=rtol, atol=1e-2 * rtol,
        )  # fmt: skip
        if not len(solution.t_events[0]):
            return found
        t_s, z = float(solution.t_events[0][0]), solution.y_events[0][0].copy()
        z[n : 2 * n] = z[:n]
        if delivered[len(found)]:
            z[2 * n :] = z[:n]
        found.append(t_s)


def stepped(
    setting: Setting,
    transitions: NDArray[np.float64],
    x0: NDArray[np.float64],
    fates: NDArray[np.bool_],
) -> NDArray[np.int64]:
    """Find the events of k runs at once by exact steps of 1 ms, with a trigger test after each.

    Args:
        setting: the settings that they share.
        transitions: (k, 3n, 3n) transition matrices of one step.
        x0: (k, n) initial states.
        fates: (k, most) fates of each run's updates.
    """
    n, trigger = x0.shape[1], setting.trigger
    steps = round(setting.horizon_s / _STEP_S)
    squares = (trigger.beta * np.exp(-trigger.alpha_per_s * _STEP_S * np.arange(steps + 1))) ** 2
    z, events = np.concatenate([x0, x0, x0], axis=1), np.ones(len(x0), np.int64)
    for step in range(1, steps + 1):
        z = np.matmul(transitions, z[:, :, None])[:, :, 0]
        error = z[:, n : 2 * n] - z[:, :n]
        for i in np.flatnonzero(np.einsum("ki,ki->k", error, error) > squares[step]):
            z[i, n : 2 * n] = z[i, :n]
            if fates[i, events[i]]:
                z[i, 2 * n :] = z[i, :n]
            events[i] += 1
    return events


def stepped_alone(
    setting: Setting, transition: NDArray[np.float64], x0: Vector, fates: NDArray[np.bool_]
) -> int:
    """Find the events of one run in the same way, with the usual plain loop."""
    n, trigger = len(x0), setting.trigger
    z, events = np.concatenate([x0, x0, x0]), 1
    for step in range(1, round(setting.horizon_s / _STEP_S) + 1):
        z = transition @ z
        error = z[n : 2 * n] - z[:n]
        threshold = trigger.beta * math.exp(-trigger.alpha_per_s * step * _STEP_S)
        if error @ error > threshold * threshold:
            z[n : 2 * n] = z[:n]
            if fates[events]:
                z[2 * n :] = z[:n]
            events += 1
    return events


def transition(setting: Setting, draw: Population) -> NDArray[np.float64]:
    """Return the transition matrix of plant and both models for a step of 1 ms."""
    n = len(setting.H)
    field = np.zeros((3 * n, 3 * n))
    field[:n, :n], field[:n, 2 * n :] = draw.A[0], draw.B[0] @ setting.K
    field[n : 2 * n, n : 2 * n] = field[2 * n :, 2 * n :] = setting.H
    return np.ascontiguousarray(expm(field * _STEP_S))


def per_s(runs: int, call: Callable[[], object]) -> float:
    """Return runs per second of this thread's CPU time, on which other load has little effect."""
    begun_ns = time.thread_time_ns()
    call()
    return runs / ((time.thread_time_ns() - begun_ns) * 1e-9)


def rows_of(mode: Mode) -> list[Row]:
    """Return the rows of a mode, all sides measured in turn."""
    setting, population, fates = drawn(mode)
    draws = [Population(*(part[i : i + 1] for part in population)) for i in range(DRAWS)]
    batch = Population(*(np.concatenate([part] * _REPEATED[mode]) for part in population))
    few = range(_INTEGRATED[mode])
    run_batch(setting, population)
    apart_s = dict.fromkeys(METHODS, 0.0)
    for method in METHODS:
        for i in few:
            found = run_events(setting, draws[i]).event_s
            expected = integrated(setting, draws[i], fates[i], method)
            same = len(found) == len(expected)
            difference_s = float(np.abs(found - expected).max()) if same else np.inf
            apart_s[method] = max(apart_s[method], difference_s)
    steps = np.array([transition(setting, one) for one in draws])
    ours, alone, together = [], [], []
    scipys: dict[Method, list[float]] = {method: [] for method in METHODS}

    def integrate(method: Method) -> list[list[float]]:
        return [integrated(setting, draws[i], fates[i], method) for i in few]

    for _ in range(ROUNDS):
        ours.append(per_s(len(batch.A), lambda: run_batch(setting, batch)))
        for method, figures in scipys.items():
            figures.append(per_s(len(few), partial(integrate, method)))
        alone.append(per_s(1, lambda: stepped_alone(setting, steps[0], population.x0[0], fates[0])))
        together.append(per_s(DRAWS, lambda: stepped(setting, steps, population.x0, fates)))
    events = float(run_batch(setting, population)["transmissions"].mean())
    name = f"lane_following, {setting.horizon_s:g} s, {mode}"

    def ratio(peer: Sequence[float]) -> float:
        return median(a / b for a, b in zip(ours, peer, strict=True))

    value, note = median(ours), f"{events:.0f} events a run"
    return [
        Row(name, value, "runs/s", goal=Goal(">=", _GOALS[mode]), note=note),
        *(
            Row(name, value, "runs/s", Peer(f"solve_ivp, {method}, rtol 1e-8", median(figures)),
                Goal(">=", 400) if method == METHODS[0] else None,
                f"event times differ from those of {method} by {apart_s[method]:.1g} s",
                None if apart_s[method] <= _AGREEMENT_S else "the two do not agree",
                ratio(figures))
            for method, figures in scipys.items()
        ),
        Row(name, value, "runs/s", Peer("numpy loop, 1 ms steps", median(alone)),
            Goal(">=", 20), paired_ratio=ratio(alone)),
        Row(name, value, "runs/s", Peer(f"the same, {DRAWS} runs at once", median(together)),
            paired_ratio=ratio(together)),
    ]  # fmt: skip


def rows_of_policies() -> list[Row]:
    """Return a row for each policy but the paper's (model mode), compared with the exact simulator.

    If losses can make the events of a policy accumulate, it is only measured with a dwell time.
    """
    rows = []
    for name, settings in POLICIES.items():
        example = settings.example(4)
        if name == "decaying" or example is None or example.events_may_accumulate:
            continue
        trigger = example.model_dump(mode="json", exclude_none=True)
        setting, population, fates = drawn("model", trigger)
        draws = [Population(*(part[i : i + 1] for part in population)) for i in range(DRAWS)]
        batch = Population(*(np.concatenate([part] * 10) for part in population))
        found = run_batch(setting, population)
        ours, exact = [], []
        for _ in range(ROUNDS):
            ours.append(per_s(len(batch.A), partial(run_batch, setting, batch)))
            exact.append(per_s(_SIMULATED, partial(simulated, setting, draws, fates)))
        runs = simulated(setting, draws, fates)
        same = all(
            np.allclose(run_events(setting, draw).event_s, run.event_s, rtol=0.0, atol=1e-9)
            for draw, run in zip(draws, runs, strict=False)
        )
        called = f"{name} of {trigger['rule']['policy']}" if "rule" in trigger else name
        rows.append(
            Row(f"lane_following, {setting.horizon_s:g} s, model, {called}",
                median(ours), "runs/s", Peer("exact simulator", median(exact)),
                note=f"{found['transmissions'].mean():.0f} events a run, "
                     f"{np.count_nonzero(found['status'])} of {DRAWS} runs fail",
                unjudged=None if same else "the two do not agree",
                paired_ratio=median(a / b for a, b in zip(ours, exact, strict=True)))
        )  # fmt: skip
    return rows


def simulated(
    setting: Setting, draws: Sequence[Population], fates: NDArray[np.bool_]
) -> list[ContinuousRun]:
    """Simulate the first few draws with the exact simulator."""
    runs = []
    for (A, B, x0, _), delivered in zip(draws[:_SIMULATED], fates, strict=False):
        loop = LoopMatrices(
            A[0], B[0], setting.K, setting.H, A[0], B[0], x0[0], setting.trigger.weight, (), ()
        )
        runs.append(simulate_continuous(
            ContinuousLoop(loop, setting.trigger), horizon_s=setting.horizon_s,
            delivered=delivered.tolist(), known_start=setting.known_start,
        ))  # fmt: skip
    return runs


def measure(options: argparse.Namespace) -> list[Row]:
    """Measure both modes of the paper's policy, and the other policies."""
    rows: list[Row] = []
    for mode in ("model", "zoh"):
        say(mode)
        rows += rows_of(mode)  # type: ignore[arg-type]
    say("other policies")
    return rows + rows_of_policies()


BENCHMARK = Benchmark("batch", "Exact runs of a batch, one core", measure)
