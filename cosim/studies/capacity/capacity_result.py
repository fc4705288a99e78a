"""What limits the number of loops on a link, for each policy, and live runs that confirm it.

A run reaches a limit if

* guarantee: a loop has used up its guarantee, because of the full queue;
* deadline: more than :data:`MOST_LATE_SHARE` of the delivered updates are late;
* cost: the mean cost of the loops is at least :data:`COST_FACTOR` times the mean over all draws of
  the cost of one loop. A run of one loop reaches it only by diverging. With several kinds of loops:
  the mean cost of a kind is at least :data:`COST_FACTOR` times that of the same loops, in the same
  draw, on a link as many times as fast as there are loops.

The capacity of a draw is the largest number of loops of the study up to which no run reaches the
limit: 0 if one loop reaches it, infinite if none does. The estimate is the median over the draws,
with the 95 % confidence interval of order statistics.

A live run has real processes, datagrams and a real bottleneck, and the seeds of draw 0. It agrees
with the simulation if its values lie within the 95 % prediction intervals of a further simulated
draw, mean ± t s √(1 + 1/k).
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.live.finalize import finalize
from cosim.live.launcher import launch
from cosim.record.run_record import load_run
from cosim.studies.campaign.campaign_summary import CampaignSummary, GridPointResult, runs_at
from cosim.studies.campaign.chunk_store import Store
from cosim.studies.campaign.drawn_runs import SharedNetworkWork
from cosim.studies.campaign.metrics import Estimate, Metric, compute_metrics, quantile_interval, quartiles
from cosim.studies.campaign.random_draws import seeds_of
from cosim.studies.capacity.capacity_plan import DISTURBANCE, LOOPS, OWN, POLICY, CapacityPlan, unshared_label
from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix, Vector

MOST_LATE_SHARE = 0.01
"""Largest share of the delivered updates that may be late."""
COST_FACTOR = 2.0
Limit = Literal["guarantee", "deadline", "cost"]
LIMITS: Mapping[Limit, Metric] = {
    "guarantee": "loops_guarantee_used",
    "deadline": "updates_late",
    "cost": "cost",
}
"""The limits and their metrics."""


class Capacity(NamedTuple):
    """The largest number of loops that a draw carries: median and 95 % confidence interval."""

    median: float
    low: float
    high: float

    @classmethod
    def estimate(cls, draws: Vector) -> "Capacity":
        """Estimate from the capacities of draws, (draws,)."""
        low, high = quantile_interval(draws, 0.5)
        return cls(quartiles(draws).median, max(low, 0.0), high)


class PolicyCapacity(NamedTuple):
    """The capacity of the link for a policy."""

    policy: str
    disturbance: str
    limits: Mapping[Limit, Capacity]
    any_limit: Capacity

    @property
    def limited_by(self) -> str:
        """The limits that are reached first; empty if none is."""
        first = min(capacity.median for capacity in self.limits.values())
        names = [name for name, capacity in self.limits.items() if capacity.median == first]
        return ", ".join(names) if np.isfinite(first) else ""

    def to_json(self, plan: CapacityPlan) -> dict[str, object]:
        """Return the capacity for JSON, also as a multiple of the given mixture if it is finite."""
        median = self.any_limit.median
        is_finite = math.isfinite(median)
        return {
            "policy": self.policy,
            "disturbance": self.disturbance,
            **self.any_limit._asdict(),
            "limited_by": self.limited_by,
            "limits": {name: capacity._asdict() for name, capacity in self.limits.items()},
            "factor": plan.factor(median) if is_finite else None,
            "loops_by_kind": plan.composition(median) if is_finite else None,
        }


def capacities(plan: CapacityPlan, summary: CampaignSummary, store: Store) -> list[PolicyCapacity]:
    """Return the capacity of the link for each policy and disturbance."""
    groups: dict[tuple[str, str], dict[str, Mapping[str, Vector]]] = {}
    for result in summary.results:
        labels = result.point.labels
        runs = {str(name): values for name, values in runs_at(result.point, store)[0].items()}
        for name, costs in store.columns(result.point.number, plan.cost_columns).items():
            runs[name] = np.where(np.isnan(costs), np.inf, costs)
        groups.setdefault((labels[POLICY], labels.get(DISTURBANCE, OWN)), {})[labels[LOOPS]] = runs
    return [capacity_of(plan, policy, disturbance, runs) for (policy, disturbance), runs in groups.items()]


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
        "deadline": values(LIMITS["deadline"]) > MOST_LATE_SHARE,
    }
    if plan.is_one_kind:
        cost = values("cost")
        finite = cost[0][np.isfinite(cost[0])]  # of one loop
        reached["cost"] = cost >= (COST_FACTOR * finite.mean() if len(finite) else 0.0)
        reached["cost"][0] = np.isinf(cost[0])  # it is the reference, however costly
    else:
        reached["cost"] = np.logical_or.reduce(
            [
                values(column)
                >= COST_FACTOR * np.stack([runs[unshared_label(count)][column] for count in plan.counts])
                for column in plan.cost_columns
            ]
        )
    draws = {limit: capacity_per_draw(plan.counts, flags) for limit, flags in reached.items()}
    limits = {limit: Capacity.estimate(counts) for limit, counts in draws.items()}
    worst = np.min(np.stack([*draws.values()]), axis=0)
    return PolicyCapacity(policy, disturbance, limits, Capacity.estimate(worst))


def capacity_per_draw(counts: Sequence[int], reached: NDArray[np.bool_]) -> Vector:
    """Return the capacity of each draw.

    Args:
        counts: ascending numbers of loops, (c,).
        reached: whether a run reaches the limit, (c, draws).
    """
    earlier_counts = np.array([0, *counts[:-1]], dtype=np.float64)
    return np.where(reached.any(axis=0), earlier_counts[np.argmax(reached, axis=0)], np.inf)


class LivePoint(NamedTuple):
    """A live run and its simulated counterparts."""

    policy: str
    loops: int
    run_dir: Path
    status: int
    reason: str
    unintended_losses: int
    values: dict[Metric, float]
    simulated: dict[Metric, tuple[float, float]]
    """Ends of the prediction intervals of the simulation."""

    @property
    def outside(self) -> list[Metric]:
        """The metrics that lie outside the interval of the simulation."""
        ends = self.simulated.items()
        return [name for name, (low, high) in ends if not low <= self.values[name] <= high]

    def to_json(self) -> dict[str, object]:
        """Return the point for JSON."""
        return {**self._asdict(), "run_dir": str(self.run_dir), "outside": self.outside}


def chosen_points(text: str | None, plan: CapacityPlan) -> list[tuple[str, int]]:
    """Return policy and number of loops of each POLICY=N of a list.

    Raises:
        CallerError: the study has no such point.
    """
    points = {f"{name}={count}": (name, count) for name in plan.policies for count in plan.counts}
    texts = [part.strip() for part in text.split(",")] if text else []
    for part in texts:
        if part not in points:
            raise CallerError(f"--confirm {part}: no such point; they are {', '.join(points)}")
    return [points[part] for part in texts]


def live_point(grid_point: tuple[str, int], results: Sequence[GridPointResult], folder: Path) -> LivePoint:
    """Run a grid point live, without the common disturbance and with the seeds of draw 0.

    Raises:
        NoackError: the run could not be started or completed.
    """
    policy, count = grid_point
    labels = {POLICY: policy, LOOPS: str(count), DISTURBANCE: OWN}
    result = next(result for result in results if {DISTURBANCE: OWN, **result.point.labels} == labels)
    point, work = result.point, result.point.work
    assert isinstance(work, SharedNetworkWork)
    changes = {"seeds": seeds_of(work.seed, 0), "name": f"{policy}-{count}"}
    outcome = finalize(launch(point.scenario.model_copy(update=changes), folder), report=False, view=False)
    rows = np.zeros(1, work.row_type)
    work.measure_loops(load_run(outcome.run_dir).loops, rows[0])
    columns = {column: rows[column] for column in work.row_type.names or ()}
    values = {key: float(value[0]) for key, value in compute_metrics(columns, None).items()}
    compared: list[Metric] = ["transmissions", *LIMITS.values()]
    return LivePoint(
        policy=policy,
        loops=count,
        run_dir=outcome.run_dir,
        status=int(outcome.status),
        reason=outcome.reason,
        unintended_losses=sum(loop.unintended_losses for loop in outcome.summary.loops),
        values={metric: values[metric] for metric in [*compared, "delay_max_s"]},
        simulated={metric: prediction_interval(result.estimates[metric]) for metric in compared},
    )


def prediction_interval(metric: Estimate) -> tuple[float, float]:
    """Return the 95 % prediction interval of a further draw; infinite from fewer than two draws."""
    if metric.finite < 2:
        return -math.inf, math.inf
    halfwidth = metric.halfwidth * math.sqrt(metric.finite + 1)
    return metric.mean - halfwidth, metric.mean + halfwidth
