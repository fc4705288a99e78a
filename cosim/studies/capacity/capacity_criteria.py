"""What limits the number of loops on a link, for each policy, with confidence intervals.

A run reaches a limit if

* guarantee: a loop has used up its guarantee, because of the full queue;
* deadline: more than :data:`LATE` of the delivered updates are late;
* cost: the mean cost of the loops is at least :data:`COST_FACTOR` times the mean over all draws of
  the cost of one loop. A run of one loop reaches it only by diverging. With several kinds of loops:
  the mean cost of a kind is at least :data:`COST_FACTOR` times that of the same loops, in the same
  draw, on a link as many times as fast as there are loops.

The capacity of a draw is the largest number of loops of the study up to which no run reaches the
limit: 0 if one loop reaches it, infinite if none does. The estimate is the median over the draws,
with the 95 % confidence interval of order statistics.

How long a study takes is estimated before it starts. The time of a run is proportional to its loops
and its steps. The time per loop and simulated second is measured with a short run on this machine,
as processor time, so that other programs that run meanwhile do not count. Loops that overload the
link take up to twice as long.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.studies.campaign.campaign_grid import Point
from cosim.studies.campaign.campaign_summary import CampaignSummary, runs_at
from cosim.studies.campaign.chunk_store import Store
from cosim.studies.campaign.metrics import Metric, quantile_interval, quartiles
from cosim.studies.campaign.sampled_draws import SharedNetworkWork
from cosim.studies.capacity.capacity_plan import (
    DISTURBANCE,
    LOOPS,
    OWN,
    POLICY,
    CapacityPlan,
    unshared,
)
from noack.core.clock import NS_PER_S
from noack.core.linear_systems import Matrix, Vector

LATE, COST_FACTOR = 0.01, 2.0
Limit = Literal["guarantee", "deadline", "cost"]
LIMITS: Mapping[Limit, Metric] = {
    "guarantee": "loops_guarantee_used", "deadline": "updates_late", "cost": "cost",
}  # fmt: skip
"""The limits and their metrics."""


class Capacity(NamedTuple):
    """The largest number of loops that a draw carries: median and 95 % confidence interval."""

    median: float
    low: float
    high: float


class PolicyCapacity(NamedTuple):
    """The capacity of the link for a policy."""

    policy: str
    disturbance: str
    limits: Mapping[Limit, Capacity]
    any_limit: Capacity

    @property
    def limited_by(self) -> str:
        """The limits that are reached first; empty if none is."""
        first = min(one.median for one in self.limits.values())
        names = [name for name, one in self.limits.items() if one.median == first]
        return ", ".join(names) if np.isfinite(first) else ""

    def document(self) -> dict[str, Any]:
        """Return the capacity for JSON."""
        limits = {name: one._asdict() for name, one in self.limits.items()}
        return {
            "policy": self.policy, "disturbance": self.disturbance,
            **self.any_limit._asdict(), "limited_by": self.limited_by, "limits": limits,
        }  # fmt: skip


def capacities(plan: CapacityPlan, summary: CampaignSummary, store: Store) -> list[PolicyCapacity]:
    """Return the capacity of the link for each policy and disturbance."""
    groups: dict[tuple[str, str], dict[str, Mapping[str, Vector]]] = {}
    for one in summary.found:
        labels = one.point.labels
        key = labels[POLICY], labels.get(DISTURBANCE, OWN)
        groups.setdefault(key, {})[labels[LOOPS]] = _measured(plan, one.point, store)
    return [capacity_of(plan, policy, how, runs) for (policy, how), runs in groups.items()]


def _measured(plan: CapacityPlan, point: Point, store: Store) -> Mapping[str, Vector]:
    """Return the metrics of the runs at a grid point, and the mean costs of the kinds."""
    costs = store.columns(point.number, plan.cost_columns)
    found: dict[str, Vector] = {str(name): one for name, one in runs_at(point, store)[0].items()}
    return found | {name: np.where(np.isnan(one), np.inf, one) for name, one in costs.items()}


def cost_limit(cost_of_one_loop: Vector) -> float:
    """Return the limit of the cost, from the cost of one loop in each draw."""
    finite = cost_of_one_loop[np.isfinite(cost_of_one_loop)]
    return COST_FACTOR * float(finite.mean()) if len(finite) else 0.0


def carried(counts: Sequence[int], reached: NDArray[np.bool_]) -> Vector:
    """Return the capacity of each draw.

    Args:
        counts: ascending numbers of loops, (c,).
        reached: whether a run reaches the limit, (c, draws).
    """
    before = np.array([0, *counts[:-1]], dtype=np.float64)
    found = before[np.argmax(reached, axis=0)]
    return np.where(reached.any(axis=0), found, np.inf)


def capacity_of(
    plan: CapacityPlan, policy: str, disturbance: str, runs: Mapping[str, Mapping[str, Vector]]
) -> PolicyCapacity:
    """Return the capacity of the link from the metrics of its runs, by the label of their number.

    Each metric has the values of the draws, (draws,).
    """

    def values(metric: str) -> Matrix:
        return np.stack([runs[str(count)][metric] for count in plan.counts])

    reached: dict[Limit, NDArray[np.bool_]] = {
        "guarantee": values(LIMITS["guarantee"]) > 0,
        "deadline": values(LIMITS["deadline"]) > LATE,
        "cost": np.zeros((len(plan.counts), plan.draws), dtype=np.bool_),
    }
    if plan.is_one_kind:
        reached["cost"] = values("cost") >= cost_limit(values("cost")[0])
        reached["cost"][0] = np.isinf(values("cost")[0])  # it is the reference, however costly
    for column in () if plan.is_one_kind else plan.cost_columns:
        own = np.stack([runs[unshared(count)][column] for count in plan.counts])
        reached["cost"] |= values(column) >= COST_FACTOR * own
    draws = {limit: carried(plan.counts, one) for limit, one in reached.items()}
    limits = {limit: _estimate(one) for limit, one in draws.items()}
    worst = np.min(np.stack([*draws.values()]), axis=0)
    return PolicyCapacity(policy, disturbance, limits, _estimate(worst))


def _estimate(draws: Vector) -> Capacity:
    low, high = quantile_interval(draws, 0.5)
    return Capacity(quartiles(draws).median, max(low, 0.0), high)


_MEASURED_LOOPS, _MEASURED_STEPS = 20, 4000
"""Number of loops of the measured run, if there is such a point, and steps of all its loops."""
_OVERLOADED = 1.2
"""Mean time of the runs of a study, relative to the measured one."""
_START_S = 3.0
"""Time until the worker processes run."""


def missing_loops(plan: CapacityPlan, points: Sequence[Point], folder: Path) -> int:
    """Return the number of loops of all runs that the folder does not have yet."""
    campaign = plan.campaign()
    store = Store(folder, points, plan.draws, campaign.chunk)
    return sum(_loops(points[one.point]) * len(one.draws) for one in store.missing())


def cpu_per_loop_s(points: Sequence[Point]) -> float:
    """Return the processor time that a loop of a run takes, in seconds."""
    point = min(points, key=lambda one: abs(_loops(one) - _MEASURED_LOOPS))
    work, loops = point.work, _loops(point)
    assert isinstance(work, SharedNetworkWork)
    step_s = work.scenario.timing.plant_period_ns / NS_PER_S
    steps = max(_MEASURED_STEPS // loops, 10)

    def spent_s(horizon_s: float) -> float:
        scenario = work.scenario.model_copy(update={"horizon_s": horizon_s})
        begin_s = time.process_time()
        replace(work, scenario=scenario).run(range(1))
        return time.process_time() - begin_s

    measured_s = min(steps * step_s, work.scenario.horizon_s)
    spent_s(min(2 * step_s, measured_s))  # imports, and code that is compiled at first use
    return spent_s(measured_s) / loops * work.scenario.horizon_s / measured_s


def estimated_s(loops: int, cpu_s: float, workers: int) -> float:
    """Return the time of runs with so many loops in all, if the workers' cores are idle."""
    return _START_S + _OVERLOADED * loops * cpu_s / workers


def time_text(seconds: float) -> str:
    """Return a rough time as text."""
    if seconds < 90:
        return f"{max(round(seconds, -1), 10):.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.2g} h"


def _loops(point: Point) -> int:
    return sum(entry.count for entry in point.scenario.loops or ())
