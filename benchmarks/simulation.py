"""The exact simulator compared with scipy's integrator with events; certificates; per call.

Both sides run the paper's example in continuous time with the same packet fates. The integrator's
accuracy is set so that its event times agree to 1e-8 s.
"""

import argparse
import os
import time
from collections.abc import Callable

# Set before numpy is imported, as the command line does: small matrices do not gain from threads.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import numpy as np

from benchmarks._report import Benchmark, Goal, Peer, Row, median, say
from benchmarks.batch import integrated
from cosim.cli import find_scenario
from cosim.simulation.batch.batch_interface import Population, setting_of
from cosim.simulation.continuous.continuous_loop import continuous_loop_of
from cosim.simulation.continuous.continuous_run import simulate_continuous
from cosim.simulation.continuous.network_fates import network_fates
from cosim.simulation.virtual_time import simulate
from noack.config.resolution import resolve
from noack.config.scenario import Scenario
from noack.config.scenario_file import load
from noack.theory.run_conditions import ideal_conditions
from noack.theory.scenario_certificates import certify

ROUNDS = 5
_RTOL = 1e-10
_AGREEMENT_S = 1e-8


def timed_ms(call: Callable[[], object]) -> float:
    """Return wall milliseconds of one call."""
    begun_ns = time.perf_counter_ns()
    call()
    return (time.perf_counter_ns() - begun_ns) / 1e6


def continuous_row(scenario: Scenario) -> Row:
    """A run in continuous time."""
    system, fate = continuous_loop_of(scenario), network_fates(scenario)
    horizon_s, loop, setting = scenario.horizon_s, system.loop, setting_of(scenario)
    fates = [fate(i) for i in range(1000)]
    draw = Population(loop.A[None], loop.B[None], loop.x0[None], np.zeros(1, np.uint64))

    def ours() -> list[float]:
        ran = simulate_continuous(system, horizon_s=horizon_s, delivered=fates, known_start=False)
        return [float(t_s) for t_s in ran.event_s]

    def theirs() -> list[float]:
        return integrated(setting, draw, np.array(fates), "DOP853", _RTOL)

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
    name = f"{scenario.horizon_s:g} s of the machines in virtual time"
    return Row(name, median(taken), "ms", peer, Goal("<=", 1e-3))


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
