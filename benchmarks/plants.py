"""Cost per step of each plant in its loop, compared with a linear plant and with its period.

The inputs are those of a simulated run of its scenario. Plant and linear plant take turns, a pair
every 2 ms and with the real-time settings, so that the processor's caches are as in a run. Figures
are the thread's CPU time, which excludes other load of the machine.
"""

import argparse
import os
import time
from collections.abc import Iterator, Sequence

# Set before numpy is imported, as the command line does: small matrices do not gain from threads.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import numpy as np

from benchmarks._report import Benchmark, Goal, Peer, Row, say
from benchmarks._ticks import FIFO_PRIORITY
from cosim.cli import find_scenario
from cosim.simulation.virtual_time import simulate
from noack.config.resolution import resolve
from noack.config.scenario import Scenario
from noack.config.scenario_file import load
from noack.config.sections import PLANTS
from noack.core.clock import NS_PER_S
from noack.core.core_library import core, ffi
from noack.protocol.record_tables import PLANT_STEP
from noack.protocol.wire_format import Flow
from noack.runtime.real_time_loop import realtime
from plant_server.plant import plants_of

STEPS = 7500
"""Maximum number: the whole scenario of the vehicles, whose slow steps are at its end."""
_PACE_NS = 2_000_000
_LINEAR = "lane_following"


def cases() -> Iterator[tuple[str, Scenario]]:
    """Yield name and resolved scenario of each kind of plant, except the linear one."""
    for kind, settings in PLANTS.items():
        for variant in settings.variants if settings.scenario not in (None, _LINEAR) else ():
            changes = [f"plant.system.{key}={value}" for key, value in variant.items()]
            scenario = resolve(load(find_scenario(settings.scenario or ""), changes))
            yield ", ".join((kind, *map(str, variant.values()))), scenario


def steps_us(scenario: Scenario, count: int) -> Iterator[float]:
    """Make the steps of a simulated run one by one; yield the CPU time of each, µs."""
    period_ns = scenario.timing.plant_period_ns
    horizon_s = min(scenario.horizon_s, count * period_ns / NS_PER_S)
    record = simulate(scenario.model_copy(update={"horizon_s": horizon_s}))
    plant = plants_of((scenario,))
    for step, u in enumerate(record[PLANT_STEP]["u"]):
        t_ns = step * period_ns
        core.noack_process_handle(plant.core, ffi.new("noack_message *", {
            "flow": Flow.ACTUATION, "sequence": step, "t_ns": t_ns,
            "entries": len(u), "vector": u.tolist(),
        }), t_ns)  # fmt: skip
        begun_ns = time.thread_time_ns()
        while (question := core.noack_process_tick(plant.core, t_ns)) != core.NOACK_DONE:
            plant.answer(question)
        plant.take_rows()
        yield (time.thread_time_ns() - begun_ns) / 1e3


def timed(
    scenario: Scenario, count: int = STEPS, pace_ns: int = _PACE_NS, *, asked: bool = True
) -> list[tuple[float, ...]]:
    """Make steps of a scenario and of a linear plant in turn; return the µs of both."""
    sides = steps_us(scenario, count), steps_us(resolve(load(find_scenario(_LINEAR))), count)
    found = []
    with realtime(asked, FIFO_PRIORITY):
        due_ns = time.monotonic_ns()
        for pair in zip(*sides, strict=False):
            found.append(pair)
            due_ns += pace_ns
            time.sleep(max(due_ns - time.monotonic_ns(), 0) / NS_PER_S)
    return found[1:]  # the first step has length 0


def rows_of(name: str, scenario: Scenario, found: Sequence[tuple[float, ...]]) -> list[Row]:
    """Return the rows of a case: median, p99, and p99 as a share of the period in wall time."""
    period_us = scenario.timing.plant_period_ns / scenario.speed / 1e3
    p50, p99 = np.quantile(np.array(found), (0.5, 0.99), axis=0).tolist()
    return [
        Row(f"{name}: p50", p50[0], "µs/step", Peer("linear plant", p50[1])),
        Row(f"{name}: p99", p99[0], "µs/step", Peer("linear plant", p99[1])),
        Row(f"{name}: p99, of {period_us / 1e3:g} ms", 100 * p99[0] / period_us, "%",
            goal=Goal("<", 20.0)),
    ]  # fmt: skip


def measure(options: argparse.Namespace) -> list[Row]:
    """Time all plants."""
    rows = []
    for name, scenario in cases():
        say(name)
        rows += rows_of(name, scenario, timed(scenario))
    return rows


BENCHMARK = Benchmark("plants", "Cost per step of the plants", measure)
