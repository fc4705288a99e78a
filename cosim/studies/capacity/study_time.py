"""How long a capacity study takes, estimated before it starts.

The time of a run is proportional to its loops and its steps. The time per loop and simulated second
is measured with a short run on this machine, as processor time, so that other programs that run
meanwhile do not count. Loops that overload the link take up to twice as long.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from cosim.studies.campaign.campaign_grid import Point
from cosim.studies.campaign.chunk_store import Store
from cosim.studies.campaign.drawn_runs import SharedNetworkWork
from cosim.studies.capacity.capacity_plan import CapacityPlan
from noack.core.clock import NS_PER_S

_MEASURED_LOOPS, _MEASURED_STEPS = 20, 4000
"""Number of loops of the measured run, if there is such a point, and steps of all its loops."""
_OVERLOADED = 1.2
"""Mean time of the runs of a study, relative to the measured one."""
_START_S = 3.0
"""Time until the worker processes run."""


def missing_loops(plan: CapacityPlan, points: Sequence[Point], folder: Path) -> int:
    """Return the number of loops of all runs that the folder does not have yet."""
    store = Store(folder, points, plan.draws, plan.campaign().chunk)
    return sum(_loops(points[chunk.point]) * len(chunk.draws) for chunk in store.missing())


def cpu_per_loop_s(points: Sequence[Point]) -> float:
    """Return the processor time that a loop of a run takes, in seconds."""
    point = min(points, key=lambda point: abs(_loops(point) - _MEASURED_LOOPS))
    work, loops = point.work, _loops(point)
    assert isinstance(work, SharedNetworkWork)
    step_s = work.scenario.timing.plant_period_ns / NS_PER_S

    def spent_s(horizon_s: float) -> float:
        scenario = work.scenario.model_copy(update={"horizon_s": horizon_s})
        begin_s = time.process_time()
        replace(work, scenario=scenario).run(range(1))
        return time.process_time() - begin_s

    measured_s = min(max(_MEASURED_STEPS // loops, 10) * step_s, work.scenario.horizon_s)
    spent_s(min(2 * step_s, measured_s))  # imports
    return spent_s(measured_s) / loops * work.scenario.horizon_s / measured_s


def estimated_s(loops: int, cpu_s: float, workers: int) -> float:
    """Return the time of runs with ``loops`` loops in all, if the workers' cores are idle."""
    return _START_S + _OVERLOADED * loops * cpu_s / workers


def rough_time(seconds: float) -> str:
    """Return a rough time as text."""
    if seconds < 90:
        return f"{max(round(seconds, -1), 10):.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.2g} h"


def _loops(point: Point) -> int:
    return sum(entry.count for entry in point.scenario.loops or ())
