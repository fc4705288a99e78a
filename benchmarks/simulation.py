"""The simulators beside scipy's integrator, live runs and earlier versions; certificates.

The exact simulator and the integrator run the paper's example in continuous time with the same
packet fates. The integrator's accuracy is set so that its event times agree to 1e-8 s.
"""

import argparse
import os

# Set before numpy is imported, as the command line does: small matrices do not gain from threads.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import numpy as np

from benchmarks._report import Benchmark, Goal, Peer, Row, compared, cpu_ms, per_cpu_s
from benchmarks.batch import apart_s, integrated
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

_RTOL, _AGREEMENT_S = 1e-10, 1e-8
_LOOPS, _LOOPS_HZ, _LOOPS_S = 50, 50.0, 10.0
_REPLAYED_S = 600.0
_SAMPLED_RUNS, _PYTHON_MACHINES_S = 20, 0.71


def continuous_row(scenario: Scenario) -> Row:
    """A run in continuous time."""
    system, fate = continuous_loop_of(scenario), network_fates(scenario)
    fates, loop = [fate(i) for i in range(1000)], system.loop
    draw = Population(loop.A[None], loop.B[None], loop.x0[None], np.zeros(1, np.uint64))
    setting, horizon_s = setting_of(scenario), scenario.horizon_s

    def ours() -> np.ndarray:
        run = simulate_continuous(system, horizon_s=horizon_s, delivered=fates, known_start=False)
        return run.event_s

    def theirs() -> list[float]:
        return integrated(setting, draw, np.array(fates), "DOP853", _RTOL)

    found, error_s = ours(), apart_s(ours(), theirs())
    return compared(
        f"{horizon_s:g} s in continuous time", "ms", cpu_ms(ours),
        (f"solve_ivp, DOP853, rtol {_RTOL:g}", cpu_ms(theirs)), Goal("<=", 0.1),
        note=f"{len(found)} events; event times differ by {error_s:.1g} s at most",
        unjudged=None if error_s <= _AGREEMENT_S else "the two do not agree",
    )  # fmt: skip


def many_loops(scenario: Scenario) -> Scenario:
    """Return many of these loops on one network."""
    content = scenario.model_dump(mode="json", exclude_none=True)
    content |= {"horizon_s": _LOOPS_S, "loops": [{"name": "loop", "count": _LOOPS}]}
    for part in ("plant", "controller"):
        content[part] |= {"rate_hz": _LOOPS_HZ}
    return validate(content, "loops")


def sampled_runs(loop: SampledLoop) -> None:
    """Make runs from event to event, as the searches make them, all measures included."""
    scales = Scales(loop.weight, np.ones(loop.last + 1), np.ones(loop.last + 1))
    runs = loop.empty(_SAMPLED_RUNS)
    for first, every in zip(loop.start(), runs, strict=True):
        every[:] = first
    while (runs.step < loop.last).any():
        loop.follow(runs, scales, np.full(_SAMPLED_RUNS, loop.last))
        loop.update(runs, runs.is_event)


def replay_row(scenario: Scenario) -> Row:
    """The replay of a long run, in memory."""
    record = simulate(scenario.model_copy(update={"horizon_s": _REPLAYED_S}))
    found = replay(record)
    return compared(
        f"replay of {_REPLAYED_S:g} s, {found.inputs:,} inputs", "× real time",
        per_cpu_s(_REPLAYED_S, lambda: replay(record)), goal=Goal(">=", 2000), rounds=3,
        unjudged=None if found.bit_exact else "the replay is not bit-exact",
    )  # fmt: skip


def measure(options: argparse.Namespace) -> list[Row]:
    """Measure the paper's example."""
    lane = resolve(load(find_scenario("lane_following"), ()))
    horizon_s, many, loop = lane.horizon_s, many_loops(lane), SampledLoop(lane)
    conditions = ideal_conditions(lane)
    work = SampledWork(in_virtual_time(lane), 0, None, None, 0.05, 10**6)
    live = Peer("the live run", 1e3 * horizon_s / lane.speed)
    earlier = Peer("the Python machines of b3991367 in virtual time", 1 / _PYTHON_MACHINES_S)
    return [
        continuous_row(lane),
        compared(f"{horizon_s:g} s of the machines in virtual time", "ms",
                 cpu_ms(lambda: simulate(lane)), live, Goal("<=", 1e-3)),
        compared(
            f"{_LOOPS} loops at {_LOOPS_HZ:g} Hz: loops × runs of {_LOOPS_S:g} s per second of CPU",
            "/s", per_cpu_s(_LOOPS, lambda: simulate_loops(many)), goal=Goal(">=", 3000)),
        compared(f"sampled runs of {horizon_s:g} s on one core", "/s",
                 per_cpu_s(_SAMPLED_RUNS, lambda: sampled_runs(loop)), earlier, Goal(">=", 100),
                 note="the alternative was measured with that version, not in this run"),
        compared("draws of a campaign in sampled time", "runs/s",
                 per_cpu_s(4, lambda: work.run(range(4)))),
        replay_row(lane),
        compared("certificate", "ms", cpu_ms(lambda: certify(lane, conditions))),
    ]  # fmt: skip


BENCHMARK = Benchmark("simulation", "Simulation and certificates", measure)
