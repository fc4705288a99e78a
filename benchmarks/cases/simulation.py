"""The simulators beside scipy's integrator, live runs and earlier versions; plants.

The exact simulator and the integrator run the paper's example with the same packet fates; their
event times must agree.
"""

import time
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from benchmarks.programs import PRIORITY
from benchmarks.report import Goal, MeasurementError, Peer, Row, announce, benchmark
from benchmarks.rounds import compare, cpu_ms, per_cpu_s
from cosim.analysis.replay import replay
from cosim.analysis.witnesses import resolved_content
from cosim.api.scenarios import with_settings
from cosim.cli.options import find_scenario
from cosim.simulation.exact_simulation import Population, Setting, run_batch, run_with_events, setting_of
from cosim.simulation.sampled_loop import SampledLoop, Scales
from cosim.simulation.virtual_time import simulate, simulate_loops
from cosim.studies.campaign.random_draws import box_of
from netem.core.clock import NS_PER_S
from netem.core.realtime_settings import realtime
from noack.core.core_library import core, ffi
from noack.core.linear_systems import Vector
from noack.proof.elaborate.scenario import read_loop
from noack.protocol.record_tables import PLANT_STEP
from noack.protocol.wire_format import Flow
from noack.scenario.resolution import ResolvedRun, resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load, validate
from noack.scenario.sections import PLANTS, POLICIES
from noack.theory.witnesses.documents import witness_by_gains
from plant_server.plant import plants_of

Method = Literal["RK45", "DOP853"]


def integrate_draw(
    setting: Setting, draw: Population, delivered: NDArray[np.bool_], method: Method
) -> list[float]:
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

    def flow(_: float, z: Vector) -> Vector:
        return np.asarray(field @ z)

    t_s, z, events_s = 0.0, np.concatenate([x, x, x]), [0.0]
    while True:
        span = t_s, setting.horizon_s
        solution = solve_ivp(flow, span, z, method=method, events=excess, rtol=1e-8, atol=1e-10)
        assert solution.t_events is not None
        assert solution.y_events is not None
        (at_s,), (states,) = solution.t_events, solution.y_events
        if not len(at_s):
            return events_s
        t_s, z = float(at_s[0]), states[0].copy()
        z[n : 2 * n] = z[:n]
        if delivered[len(events_s)]:
            z[2 * n :] = z[:n]
        events_s.append(t_s)


def apart_s(events_s: Vector, expected: list[float]) -> float:
    """Return the largest difference of event times; infinite if their numbers differ."""
    same = len(events_s) == len(expected)
    return float(np.abs(np.subtract(events_s, expected)).max()) if same else np.inf


_LOOPS, _LOOPS_HZ, _LOOPS_S = 50, 50.0, 10.0
_REPLAYED_S = 600.0
_SAMPLED_RUNS = 20
_PYTHON_MACHINES_S = 0.71
"""Time of a run by the Python machines of b3991367."""


def sampled_runs(loop: SampledLoop) -> None:
    """Make runs from event to event, as the searches make them, all measures included."""
    scales = Scales(loop.weight, np.ones(loop.last + 1), np.ones(loop.last + 1))
    runs = loop.empty(_SAMPLED_RUNS)
    for first, every in zip(loop.start(), runs, strict=True):
        every[:] = first
    while (runs.step < loop.last).any():
        loop.follow(runs, scales, np.full(_SAMPLED_RUNS, loop.last))
        loop.transmit(runs, runs.is_event)


def proved_by_gains(resolved: Scenario) -> None:
    """Prove the bounds of a scenario's schedule that need no search."""
    loop = read_loop(resolved_content(resolved), box=False, ideal=False)
    witness_by_gains(loop, ("x", "e_c", "e_s"))


@benchmark("simulation", "Simulation and certificates")
def simulation() -> Iterator[Row]:
    """Measure the simulators, a replay and a certificate with the paper's example."""
    lane = resolve(load(find_scenario("lane_following"), ()))
    settings = dict.fromkeys(("plant.rate_hz", "controller.rate_hz"), _LOOPS_HZ)
    loops = {"horizon_s": _LOOPS_S, "loops": [{"name": "loop", "count": _LOOPS}]}
    many = with_settings(lane, settings | loops)  # equal loops: nothing is drawn
    horizon_s, loop = lane.horizon_s, SampledLoop(lane)
    live = Peer("the live run", 1e3 * horizon_s / lane.speed)
    name = f"{horizon_s:g} s of the machines in virtual time"
    yield compare(name, "ms", cpu_ms(lambda: simulate(lane)), live, Goal("<=", 1e-3))
    name = f"{_LOOPS} loops at {_LOOPS_HZ:g} Hz: loops × runs of {_LOOPS_S:g} s per second of CPU"
    yield compare(
        name, "/s", per_cpu_s(_LOOPS, lambda: simulate_loops(ResolvedRun(many))), goal=Goal(">=", 3000)
    )
    name, side = f"sampled runs of {horizon_s:g} s on one core", lambda: sampled_runs(loop)
    earlier = Peer("the Python machines of b3991367 in virtual time", 1 / _PYTHON_MACHINES_S)
    note = "the alternative was measured with that version, not in this run"
    yield compare(name, "/s", per_cpu_s(_SAMPLED_RUNS, side), earlier, Goal(">=", 100), note=note)
    record = simulate(lane.model_copy(update={"horizon_s": _REPLAYED_S}))
    replayed = replay(record)
    if not replayed.bit_exact:
        raise MeasurementError("the replay is not bit-exact")
    name, replaying = f"replay of {_REPLAYED_S:g} s, {replayed.inputs:,} inputs", lambda: replay(record)
    yield compare(name, "× real time", per_cpu_s(_REPLAYED_S, replaying), goal=Goal(">=", 2000), rounds=3)

    yield compare("certificate without a search", "ms", cpu_ms(lambda: proved_by_gains(lane)))


DRAWS = 200
"""Number of different plants and losses; a batch repeats them."""
ENGINE = {"model": 40, "zoh": 8}
"""Repetitions of the draws in a batch."""
INTEGRATED = {"model": 20, "zoh": 3}
"""Runs of the integrator in a round."""
_AGREEMENT_S = 1e-4
"""Accumulated effect of the integrator's errors of 1e-8 over hundreds of events."""


def draw_population(mode: str, trigger: Mapping[str, Any] | None = None) -> tuple[Setting, Population]:
    """Return draws of the lane example, by default with the paper's trigger."""
    content = load(find_scenario("lane_following"), ()).model_dump(mode="json", exclude_none=True)
    changes = {"mode": mode} | ({} if trigger is None else {"trigger": trigger})
    scenario = validate(content | changes, "lane_following")
    return setting_of(resolve(scenario)), box_of(scenario).population(0, range(DRAWS))


_BATCH_GOALS = {"model": Goal(">=", 2000), "zoh": Goal(">=", 1500)}
"""By mode."""


def batch_rows(mode: str) -> Iterator[Row]:
    """Yield the rows of a mode: the engine beside the integrator's default, and its fastest."""
    setting, population = draw_population(mode)
    rows, events = run_with_events(setting, population)
    draws = [Population._make(part[i : i + 1] for part in population) for i in range(DRAWS)]
    batch = Population._make(np.concatenate([part] * ENGINE[mode]) for part in population)
    few = range(INTEGRATED[mode])
    engine = per_cpu_s(len(batch.A), lambda: run_batch(setting, batch))
    methods: dict[Method, Goal | None] = {"RK45": _BATCH_GOALS[mode], "DOP853": None}
    for method, goal in methods.items():

        def integrate(method: Method = method) -> list[list[float]]:
            # The last event has no fate that matters.
            fates = [np.append(events[i].delivered, False) for i in few]
            return [integrate_draw(setting, draws[i], fates[i], method) for i in few]

        error_s = max(map(apart_s, (events[i].event_s for i in few), integrate()))
        if error_s > _AGREEMENT_S:
            raise MeasurementError(f"event times differ by {error_s:.1g} s from those of {method}")
        name = f"exact runs of {setting.horizon_s:g} s, {mode}"
        peer = f"solve_ivp, {method}, rtol 1e-8", per_cpu_s(len(few), integrate)
        note = f"{rows['transmissions'].mean():.0f} events a run, whose times differ by {error_s:.1g} s"
        yield compare(name, "/s", engine, peer, goal, note=note)


@benchmark("batch", "Exact runs of a batch, one core")
def batches() -> Iterator[Row]:
    """Compare the batch engine with scipy's integrator, and each policy with the paper's.

    Both sides use the same draws of the lane example. The engine also measures each run (cost,
    settling time, supremum of the error); the integrator only finds the events. With "lyapunov"
    alone the events may accumulate where updates are lost: it is only measured with a dwell time.
    """
    yield from batch_rows("model")
    yield from batch_rows("zoh")
    paper = draw_population("model")
    for name, settings in POLICIES.items():
        example = settings.example(4)
        if name in ("decaying", "lyapunov") or example is None:
            continue
        trigger = example.model_dump(mode="json", exclude_none=True)
        whole = f"{name} of {trigger['rule']['policy']}" if "rule" in trigger else name
        other = draw_population("model", trigger)
        side, peer = (per_cpu_s(DRAWS, partial(run_batch, *run)) for run in (other, paper))
        yield compare(f"model, {whole}", "runs/s", side, ("decaying", peer))


STEPS = 7500
"""Maximum number."""
_PACE_NS = 2_000_000
"""Time between two pairs of steps."""
_LINEAR = "lane_following"


def steps_us(scenario: Scenario) -> Iterator[float]:
    """Make the steps of a simulated run one by one; yield the CPU time of each, µs."""
    period_ns = scenario.timing.plant_period_ns
    horizon_s = min(scenario.horizon_s, STEPS * period_ns / NS_PER_S)
    record = simulate(scenario.model_copy(update={"horizon_s": horizon_s}))
    plant = plants_of((scenario,))
    for step, u in enumerate(record[PLANT_STEP]["u"]):
        t_ns = step * period_ns
        core.noack_process_handle(plant.core, ffi.new("noack_message *", {
            "flow": Flow.ACTUATION, "sequence": step, "t_ns": t_ns,
            "entries": len(u), "vector": u.tolist(),
        }), t_ns)  # fmt: skip
        began_ns = time.thread_time_ns()
        core.noack_process_tick(plant.core, t_ns)
        plant.take_rows()
        yield (time.thread_time_ns() - began_ns) / 1e3


def plant_rows(name: str, scenario: Scenario) -> Iterator[Row]:
    """Yield a plant's median, p99, and p99 as a share of its period in wall time."""
    announce(name)
    sides = steps_us(scenario), steps_us(resolve(load(find_scenario(_LINEAR))))
    timed_us = list[tuple[float, ...]]()
    with realtime(True, PRIORITY):
        due_ns = time.monotonic_ns()
        for pair_us in zip(*sides, strict=False):
            timed_us.append(pair_us)
            due_ns += _PACE_NS
            time.sleep(max(due_ns - time.monotonic_ns(), 0) / NS_PER_S)
    # The first step has length 0.
    p50, p99 = np.quantile(np.array(timed_us[1:]), (0.5, 0.99), axis=0).tolist()
    period_us = scenario.timing.plant_period_ns / scenario.speed / 1e3
    yield Row(f"{name}: p50", p50[0], "µs/step", Peer("linear plant", p50[1]))
    yield Row(f"{name}: p99", p99[0], "µs/step", Peer("linear plant", p99[1]))
    yield Row(f"{name}: p99, of {period_us / 1e3:g} ms", 100 * p99[0] / period_us, "%", goal=Goal("<", 20.0))


@benchmark("plants", "Cost per step of the plants")
def plants() -> Iterator[Row]:
    """Measure the cost per step of each plant in its loop, beside a linear plant and its period.

    The inputs are those of a simulated run of its scenario. Plant and linear plant take turns, a
    pair every 2 ms, so that the processor's caches are as in a run.
    """
    for kind, settings in PLANTS.items():
        if settings.scenario not in (None, _LINEAR):
            yield from plant_rows(kind, resolve(load(find_scenario(settings.scenario or ""))))
