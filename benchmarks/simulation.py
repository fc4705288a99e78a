"""The exact simulator compared with scipy's integrator with events; certificates; per call.

Both sides run the paper's example in continuous time with the same packet fates. The integrator's
accuracy is set so that its event times agree to 1e-8 s.
"""

import argparse
import os
import time
from collections.abc import Callable, Sequence

# Set before numpy is imported, as the command line does: small matrices do not gain from threads.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import numpy as np
from scipy.integrate import solve_ivp

from benchmarks._report import Benchmark, Goal, Peer, Row, median, say
from cosim.cli import find_scenario
from cosim.simulation.continuous.continuous_loop import ContinuousLoop, continuous_loop_of
from cosim.simulation.continuous.continuous_run import simulate_continuous
from cosim.simulation.continuous.network_fates import network_fates
from cosim.simulation.virtual_time import simulate
from noack.config.resolution import resolve
from noack.config.scenario import Scenario
from noack.config.scenario_file import load
from noack.core.linear_systems import Vector
from noack.theory.run_conditions import ideal_conditions
from noack.theory.scenario_certificates import certify

ROUNDS = 5
_RTOL = 1e-10
_AGREEMENT_S = 1e-8


def integrated_events(
    system: ContinuousLoop, horizon_s: float, delivered: Sequence[bool]
) -> list[float]:
    """Return event times by ``solve_ivp``, from one threshold crossing to the next."""
    n, generator = system.loop.n, system.generator
    trigger = system.trigger

    def field(t_s: float, z: Vector) -> Vector:
        return np.asarray(generator @ z)

    def crossing(t_s: float, z: Vector) -> float:
        return float(np.log(np.linalg.norm(z[n : 2 * n]) + 1e-300) - np.log(trigger.beta)
                     + trigger.alpha_per_s * t_s)  # fmt: skip

    crossing.terminal, crossing.direction = True, 1.0  # type: ignore[attr-defined]
    z, t_s, found = np.concatenate([system.loop.x0, np.zeros(2 * n)]), 0.0, [0.0]
    while True:
        solution = solve_ivp(
            field, (t_s, horizon_s), z, events=crossing, method="DOP853", rtol=_RTOL, atol=1e-14
        )
        if not len(solution.t_events[0]):
            return found
        t_s, z = float(solution.t_events[0][0]), solution.y_events[0][0].copy()
        z[n : 2 * n] = 0.0
        if delivered[len(found)]:
            z[2 * n :] = 0.0
        found.append(t_s)


def timed_ms(call: Callable[[], object]) -> float:
    """Return wall milliseconds of one call."""
    begun_ns = time.perf_counter_ns()
    call()
    return (time.perf_counter_ns() - begun_ns) / 1e6


def continuous_row(scenario: Scenario) -> Row:
    """A run in continuous time."""
    system, fate = continuous_loop_of(scenario), network_fates(scenario)
    fates, horizon_s = [fate(i) for i in range(1000)], scenario.horizon_s

    def ours() -> list[float]:
        ran = simulate_continuous(system, horizon_s=horizon_s, delivered=fates, known_start=False)
        return [float(t_s) for t_s in ran.event_s]

    def theirs() -> list[float]:
        return integrated_events(system, horizon_s, fates)

    found, expected = ours(), theirs()
    same = len(found) == len(expected)
    apart_s = float(np.abs(np.subtract(found, expected)).max()) if same else np.inf
    note = f"{len(found)} events; event times differ by {apart_s:.1g} s at most"
    times = [(timed_ms(ours), timed_ms(theirs)) for _ in range(ROUNDS)]
    peer = Peer(f"solve_ivp, DOP853, rtol {_RTOL:g}", median(theirs for _, theirs in times))
    goal = Goal("<=", 0.1)
    unjudged = None if apart_s <= _AGREEMENT_S else "the two do not agree"
    name = f"{horizon_s:g} s in continuous time"
    return Row(name, median(ours for ours, _ in times), "ms", peer, goal, note, unjudged)


def sampled_row(scenario: Scenario) -> Row:
    """A run of the machines in virtual time, compared with its duration as a live run."""
    taken = [timed_ms(lambda: simulate(scenario)) for _ in range(ROUNDS)]
    peer = Peer("the live run", 1e3 * scenario.horizon_s / scenario.speed)
    return Row(f"{scenario.horizon_s:g} s of the machines", median(taken), "ms", peer)


def certificate_row(scenario: Scenario) -> Row:
    """A certificate, computed without caches."""
    conditions = ideal_conditions(scenario)
    taken = [timed_ms(lambda: certify(scenario, conditions)) for _ in range(ROUNDS)]
    return Row("certificate", median(taken), "ms")


def measure(options: argparse.Namespace) -> list[Row]:
    """Measure the paper's example."""
    scenario = resolve(load(find_scenario("lane_following"), ()))
    rows = []
    for row in (continuous_row, sampled_row, certificate_row):
        say(row.__name__)
        rows.append(row(scenario))
    return rows


BENCHMARK = Benchmark("simulation", "Simulation and certificates", measure)
