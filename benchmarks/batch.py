"""The batch engine compared with what a user would write, in runs per second on one core.

Both sides use the same draws of the lane example, with the same packet fates: the engine, and
scipy's integrator with an event function, at rtol 1e-8. The engine also measures each run (cost,
settling time, supremum of the error); the integrator only finds the events.
"""

import argparse
import os
from collections.abc import Mapping
from typing import Any

# Set before numpy is imported, as the command line does: small matrices do not gain from threads.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from benchmarks._report import Benchmark, Goal, Row, compared, median, per_cpu_s
from cosim.cli import find_scenario
from cosim.simulation.batch import Population, Setting, run_batch, run_with_events, setting_of
from cosim.studies.campaign.random_draws import box_of
from noack.config.resolution import resolve
from noack.config.scenario_file import load, validate
from noack.config.sections import POLICIES
from noack.core.linear_systems import Vector

DRAWS = 200
"""Number of different plants and losses; a batch repeats them."""
_ENGINE = {"model": 40, "zoh": 8}
"""Repetitions of the draws in a batch."""
_INTEGRATED = {"model": 20, "zoh": 3}
"""Runs of the integrator in a round."""
_FASTEST = {"model": 20_000.0, "zoh": 3_000.0}
_AGREEMENT_S = 1e-4
"""Accumulated effect of the integrator's errors of 1e-8 over hundreds of events."""


def drawn(mode: str, trigger: Mapping[str, Any] | None = None) -> tuple[Setting, Population]:
    """Return draws of the lane example, by default with the paper's trigger."""
    content = load(find_scenario("lane_following"), ()).model_dump(mode="json", exclude_none=True)
    changes = {"mode": mode} | ({} if trigger is None else {"trigger": trigger})
    scenario = validate(content | changes, "lane_following")
    return setting_of(resolve(scenario)), box_of(scenario).population(0, range(DRAWS))


def integrated(
    setting: Setting, draw: Population, delivered: NDArray[np.bool_], method: str,
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


def apart_s(found: Vector, expected: list[float]) -> float:
    """Return the largest difference of event times; infinite if their numbers differ."""
    same = len(found) == len(expected)
    return float(np.abs(np.subtract(found, expected)).max()) if same else np.inf


def rows_of(mode: str) -> list[Row]:
    """Return the rows of a mode: the engine beside the integrator's default, and its fastest."""
    setting, population = drawn(mode)
    rows, events = run_with_events(setting, population)
    draws = [Population(*(part[i : i + 1] for part in population)) for i in range(DRAWS)]
    batch = Population(*(np.concatenate([part] * _ENGINE[mode]) for part in population))
    few = range(_INTEGRATED[mode])
    engine = per_cpu_s(len(batch.A), lambda: run_batch(setting, batch))
    name, found = f"lane_following, {setting.horizon_s:g} s, {mode}", list[Row]()
    for method, goal in (("RK45", Goal(">=", 1000)), ("DOP853", None)):

        def integrate(method: str = method) -> list[list[float]]:
            # The last event has no fate that matters.
            fates = [np.append(events[i].delivered, False) for i in few]
            return [integrated(setting, draws[i], fates[i], method) for i in few]

        error_s = max(map(apart_s, (events[i].event_s for i in few), integrate()))
        found.append(
            compared(
                name, "runs/s", engine,
                (f"solve_ivp, {method}, rtol 1e-8", per_cpu_s(len(few), integrate)), goal,
                note=f"event times differ from those of {method} by {error_s:.1g} s",
                unjudged=None if error_s <= _AGREEMENT_S else "the two do not agree",
            )
        )  # fmt: skip
    value = median(row.value for row in found if row.value is not None)
    note = f"{rows['transmissions'].mean():.0f} events a run"
    return [Row(name, value, "runs/s", goal=Goal(">=", _FASTEST[mode]), note=note), *found]


def rows_of_policies() -> list[Row]:
    """Return a row for each policy but the paper's (model mode), compared with the paper's.

    If losses can make the events of a policy accumulate, it is only measured with a dwell time.
    """
    paper, rows = drawn("model"), []
    for name, settings in POLICIES.items():
        example = settings.example(4)
        if name == "decaying" or example is None or example.events_may_accumulate:
            continue
        trigger = example.model_dump(mode="json", exclude_none=True)
        whole = f"{name} of {trigger['rule']['policy']}" if "rule" in trigger else name
        other = drawn("model", trigger)
        side, peer = (per_cpu_s(DRAWS, lambda run=run: run_batch(*run)) for run in (other, paper))
        rows.append(compared(f"model, {whole}", "runs/s", side, ("decaying", peer)))
    return rows


def measure(options: argparse.Namespace) -> list[Row]:
    """Measure both modes of the paper's policy, and the other policies."""
    return [*rows_of("model"), *rows_of("zoh"), *rows_of_policies()]


BENCHMARK = Benchmark("batch", "Exact runs of a batch, one core", measure)
