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
from cosim.analysis.replay import replay
from cosim.cli import find_scenario
from cosim.simulation.batch import Population, setting_of
from cosim.simulation.continuous import continuous_loop_of, network_fates, simulate_continuous
from cosim.simulation.sampled_loop import SampledLoop, Scales
from cosim.simulation.virtual_time import simulate, simulate_loops
from cosim.studies.campaign.sampled_draws import SampledWork, in_virtual_time
from noack.config.resolution import resolve
from noack.config.scenario import Scenario
from noack.config.scenario_file import load, validate
from noack.theory.certificates.conditions import ideal_conditions
from noack.theory.certificates.scenario_certificates import certify

ROUNDS = 5
_RTOL = 1e-10
_AGREEMENT_S = 1e-8
_LOOPS, _LOOPS_HZ, _LOOPS_S = 50, 50.0, 10.0
_REPLAYED_S = 600.0
_SAMPLED_RUNS, _PYTHON_MACHINES_S = 20, 0.71


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


def loops_row(scenario: Scenario) -> Row:
    """Many loops on one network in virtual time: CPU time of the whole simulation."""
    content = scenario.model_dump(mode="json", exclude_none=True)
    content |= {"horizon_s": _LOOPS_S, "loops": [{"name": "loop", "count": _LOOPS}]}
    for part in ("plant", "controller"):
        content[part] |= {"rate_hz": _LOOPS_HZ}
    many = validate(content, "loops")
    rates = []
    for _ in range(ROUNDS):
        begun_s = time.process_time()
        simulate_loops(many)
        rates.append(_LOOPS / (time.process_time() - begun_s))
    name = f"{_LOOPS} loops at {_LOOPS_HZ:g} Hz: loops × runs of {_LOOPS_S:g} s per second of CPU"
    return Row(name, median(rates), "/s", goal=Goal(">=", 3000))


def sampled_runs_row(scenario: Scenario) -> Row:
    """Sampled runs from event to event, as the searches make them, all measures included."""
    loop = SampledLoop(scenario)
    scales = Scales(loop.weight, np.ones(loop.last + 1), np.ones(loop.last + 1))
    rates = []
    for _ in range(ROUNDS):
        one, runs = loop.start(), loop.empty(_SAMPLED_RUNS)
        for first, every in zip(one, runs, strict=True):
            every[:] = first
        begun_s = time.process_time()
        while (runs.step < loop.last).any():
            loop.follow(runs, scales, np.full(_SAMPLED_RUNS, loop.last))
            loop.update(runs, runs.is_event)
        rates.append(_SAMPLED_RUNS / (time.process_time() - begun_s))
    peer = Peer("the Python machines of b3991367 in virtual time", 1 / _PYTHON_MACHINES_S)
    note = "the alternative was measured with that version, not in this run: 710 ms for 20 s"
    return Row("sampled runs of 20 s on one core", median(rates), "/s", peer, Goal(">=", 100), note)


def sampled_draws_row(scenario: Scenario) -> Row:
    """Draws of a campaign in sampled time: the whole run and its measures."""
    work = SampledWork(in_virtual_time(scenario), 0, None, None, 0.05, 10**6)
    rates = []
    for number in range(ROUNDS):
        begun_s = time.process_time()
        work.run(range(4 * number, 4 * number + 4))
        rates.append(4 / (time.process_time() - begun_s))
    return Row("draws of a campaign in sampled time", median(rates), "runs/s")


def replay_row(scenario: Scenario) -> Row:
    """The replay of a long run, in memory."""
    record = simulate(scenario.model_copy(update={"horizon_s": _REPLAYED_S}))
    begun_s = time.process_time()
    found = replay(record)
    used_s = time.process_time() - begun_s
    unjudged = None if found.bit_exact else "the replay is not bit-exact"
    name = f"replay of {_REPLAYED_S:g} s, {found.inputs:,} inputs"
    return Row(name, _REPLAYED_S / used_s, "× real time", goal=Goal(">=", 2000), unjudged=unjudged)


def certificate_row(scenario: Scenario) -> Row:
    """A certificate, computed without caches."""
    conditions = ideal_conditions(scenario)
    taken = [timed_ms(lambda: certify(scenario, conditions)) for _ in range(ROUNDS)]
    return Row("certificate", median(taken), "ms")


def measure(options: argparse.Namespace) -> list[Row]:
    """Measure the paper's example."""
    scenario = resolve(load(find_scenario("lane_following"), ()))
    rows = []
    for row in (
        continuous_row, sampled_row, loops_row, sampled_runs_row, sampled_draws_row, replay_row,
        certificate_row,
    ):  # fmt: skip
        say(row.__name__)
        rows.append(row(scenario))
    return rows


BENCHMARK = Benchmark("simulation", "Simulation and certificates", measure)
