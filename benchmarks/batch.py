"""The batch engine compared with what a user would write, in runs per second on one core.

Both sides use the same draws of the lane example, with the same packet fates: the engine, and
scipy's integrator with an event function, at rtol 1e-8. The engine also measures each run (cost,
settling time, supremum of the error); the integrator only finds the events.
"""

import argparse
import json
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

from benchmarks._report import Benchmark, Goal, Peer, Rounds, Row, median, say
from cosim.cli import find_scenario
from cosim.simulation.batch import (
    Population,
    Setting,
    run_batch,
    run_events,
    setting_of,
)
from cosim.simulation.continuous import network_fates
from noack.config.resolution import loop_of, resolve
from noack.config.run_sections import SeedsSection
from noack.config.scenario import Scenario
from noack.config.scenario_file import load
from noack.config.sections import POLICIES
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
_FATES = 1000
_AGREEMENT_S = 1e-4
"""Accumulated effect of the integrator's errors of 1e-8 over hundreds of events."""
_GOALS = {"model": 20_000.0, "zoh": 3_000.0}


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
        return error - trigger.level * float(np.exp(-trigger.rate_per_s * t_s))

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
    ours: list[float] = []
    scipys: dict[Method, list[float]] = {method: [] for method in METHODS}

    def integrate(method: Method) -> list[list[float]]:
        return [integrated(setting, draws[i], fates[i], method) for i in few]

    for _ in range(ROUNDS):
        ours.append(per_s(len(batch.A), lambda: run_batch(setting, batch)))
        for method, figures in scipys.items():
            figures.append(per_s(len(few), partial(integrate, method)))
    events = float(run_batch(setting, population)["transmissions"].mean())
    name = f"lane_following, {setting.horizon_s:g} s, {mode}"

    def ratio(peer: Sequence[float]) -> float:
        return median(a / b for a, b in zip(ours, peer, strict=True))

    value, note = median(ours), f"{events:.0f} events a run"
    return [
        Row(name, value, "runs/s", goal=Goal(">=", _GOALS[mode]), note=note),
        *(
            Row(name, value, "runs/s", Peer(f"solve_ivp, {method}, rtol 1e-8", median(figures)),
                Goal(">=", 1000) if method == METHODS[0] else None,
                f"event times differ from those of {method} by {apart_s[method]:.1g} s",
                None if apart_s[method] <= _AGREEMENT_S else "the two do not agree",
                ratio(figures))
            for method, figures in scipys.items()
        ),
    ]  # fmt: skip


def rows_of_policies() -> list[Row]:
    """Return a row for each policy but the paper's (model mode), compared with the paper's.

    If losses can make the events of a policy accumulate, it is only measured with a dwell time.
    """
    names, triggers = ["decaying"], [None]
    for name, settings in POLICIES.items():
        example = settings.example(4)
        if name != "decaying" and example is not None and not example.events_may_accumulate:
            triggers.append(example.model_dump(mode="json", exclude_none=True))
            rule = triggers[-1].get("rule")
            names.append(name if rule is None else f"{name} of {rule['policy']}")
    rounds = Rounds()
    batches = [drawn("model", trigger)[:2] for trigger in triggers]
    for number in range(-1, ROUNDS):
        for name, (setting, population) in zip(names, batches, strict=True):
            speed = per_s(DRAWS, partial(run_batch, setting, population))
            if number >= 0:
                rounds.add(name, {"per_s": speed})
    return [
        rounds.row(f"model, {name}", "runs/s", "per_s", name, names[0], paired=True)
        for name in names[1:]
    ]


def measure(options: argparse.Namespace) -> list[Row]:
    """Measure both modes of the paper's policy, and the other policies."""
    rows: list[Row] = []
    for mode in ("model", "zoh"):
        say(mode)
        rows += rows_of(mode)  # type: ignore[arg-type]
    say("other policies")
    return rows + rows_of_policies()


BENCHMARK = Benchmark("batch", "Exact runs of a batch, one core", measure)
