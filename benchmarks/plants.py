"""Cost per step of each plant in its loop, compared with a linear plant and with its period.

The inputs are those of a simulated run of its scenario. Plant and linear plant take turns, a step
every 2 ms and with the real-time settings, so that the processor's caches are as in a run. Figures
are the thread's CPU time, which excludes other load of the machine.
"""

import argparse
import os
import time
from typing import NamedTuple

# Set before numpy is imported, as the command line does: small matrices do not gain from threads.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import numpy as np
from numpy.typing import NDArray

from benchmarks._report import Benchmark, Goal, Peer, Row, say
from benchmarks._ticks import FIFO_PRIORITY
from cosim.cli import find_scenario
from cosim.simulation.virtual_time import simulate
from noack.config.resolution import resolve
from noack.config.scenario import Scenario
from noack.config.scenario_file import load
from noack.config.sections import PLANTS
from noack.core.clock import NS_PER_S
from noack.protocol.record_tables import PLANT_STEP
from noack.protocol.wire_format import Flow, Message
from noack.runtime.real_time_settings import realtime
from plant_server.plant import plants_of

STEPS = 7500
"""Maximum number: the whole scenario of the vehicles, whose slow steps are at its end."""
PACE_NS = 2_000_000
SHARE = Goal("<", 20.0)
"""Goal for a step's p99, in percent of its period."""
LINEAR = "lane_following"


class Case(NamedTuple):
    """A plant: its scenario, and the settings changed in it."""

    name: str
    scenario: str
    settings: tuple[str, ...]
    goal: Goal


CASES = tuple(
    Case(
        ", ".join((kind, *map(str, variant.values()))),
        settings.scenario,
        tuple(f"plant.system.{key}={value}" for key, value in variant.items()),
        SHARE,
    )
    for kind, settings in PLANTS.items()
    if settings.scenario not in (None, LINEAR)
    for variant in settings.variants
)
"""All kinds of plants with a scenario, except the linear one."""


class Steps:
    """A plant that repeats the steps of a simulated run of its scenario, one by one."""

    def __init__(self, scenario: str, settings: tuple[str, ...], count: int) -> None:
        self.resolved: Scenario = resolve(load(find_scenario(scenario), settings))
        horizon_s = min(
            self.resolved.horizon_s, count * self.resolved.timing.plant_period_ns / NS_PER_S
        )
        record = simulate(self.resolved.model_copy(update={"horizon_s": horizon_s}))
        self._plant = plants_of((self.resolved,))
        self._period_ns = self.resolved.timing.plant_period_ns
        self._inputs = iter(record[PLANT_STEP]["u"])
        self._step = 0
        self.cpu_ns: list[int] = []

    def make(self) -> bool:
        """Make a step; False at the run's end."""
        u = next(self._inputs, None)
        if u is None:
            return False
        t_ns = self._step * self._period_ns
        self._plant.handle(Message(Flow.ACTUATION, self._step, t_ns, u), t_ns)
        begun_ns = time.thread_time_ns()
        self._plant.on_timer(t_ns)
        self.cpu_ns.append(time.thread_time_ns() - begun_ns)
        self._step += 1
        return True

    @property
    def us(self) -> NDArray[np.float64]:
        """CPU time of the steps so far, µs, without the first, which has length 0."""
        return np.array(self.cpu_ns[1:]) / 1e3


def timed(
    case: Case, count: int = STEPS, pace_ns: int = PACE_NS, *, asked: bool = True
) -> tuple[Steps, Steps]:
    """Make steps of a case and of a linear plant in turn; request the real-time settings."""
    ours, linear = Steps(case.scenario, case.settings, count), Steps(LINEAR, (), count)
    with realtime(asked, FIFO_PRIORITY):
        due_ns = time.monotonic_ns()
        for steps in (ours, linear) * count:
            if not steps.make():
                break
            due_ns += pace_ns
            time.sleep(max(due_ns - time.monotonic_ns(), 0) / NS_PER_S)
    return ours, linear


def rows_of(case: Case, ours: Steps, linear: Steps) -> list[Row]:
    """Return the rows of a case: median, p99, and p99 as a share of the period in wall time."""
    period_us = ours.resolved.timing.plant_period_ns / ours.resolved.speed / 1e3
    found = {q: (float(np.quantile(ours.us, q)), float(np.quantile(linear.us, q)))
             for q in (0.5, 0.99)}  # fmt: skip
    share = 100 * found[0.99][0] / period_us
    return [
        *(
            Row(f"{case.name}: {name}", value, "µs/step", Peer("linear plant", peer))
            for name, (value, peer) in zip(("p50", "p99"), found.values(), strict=True)
        ),
        Row(f"{case.name}: p99, of {period_us / 1e3:g} ms", share, "%", goal=case.goal),
    ]


def measure(options: argparse.Namespace) -> list[Row]:
    """Time all plants."""
    rows = []
    for case in CASES:
        say(case.name)
        rows += rows_of(case, *timed(case))
    return rows


BENCHMARK = Benchmark("plants", "Cost per step of the plants", measure)
