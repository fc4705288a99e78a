"""Points of a capacity study as live runs: real processes, real datagrams, the real bottleneck.

A live run has the seeds of draw 0. It agrees with the simulation if its values lie within the 95 %
prediction intervals of a further simulated draw, mean ± t s √(1 + 1/k).
"""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cosim.live.finalize import finalize
from cosim.live.launcher import launch
from cosim.record.run_record import load_run
from cosim.studies.campaign.campaign_summary import GridPointResult
from cosim.studies.campaign.metrics import Estimate, Metric, measured
from cosim.studies.campaign.random_draws import seeds_of
from cosim.studies.campaign.sampled_draws import SharedNetworkWork
from cosim.studies.capacity.capacity_criteria import LIMITS
from cosim.studies.capacity.capacity_plan import DISTURBANCE, LOOPS, OWN, POLICY, CapacityPlan
from noack.core.errors import CallerError


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
        return [
            name for name, (low, high) in self.simulated.items()
            if not low <= self.values[name] <= high
        ]  # fmt: skip

    def document(self) -> dict[str, Any]:
        """Return the point for JSON."""
        return {**self._asdict(), "run_dir": str(self.run_dir), "outside": self.outside}


def chosen_points(text: str | None, plan: CapacityPlan) -> list[tuple[str, int]]:
    """Return policy and number of loops of each POLICY=N of a list.

    Raises:
        CallerError: the study has no such point.
    """
    points = {f"{name}={count}": (name, count) for name in plan.policies for count in plan.counts}
    texts = [one.strip() for one in text.split(",")] if text else []
    for one in texts:
        if one not in points:
            raise CallerError(f"--confirm {one}: no such point; they are {', '.join(points)}")
    return [points[one] for one in texts]


def live_point(
    chosen: tuple[str, int], found: Iterable[GridPointResult], folder: Path
) -> LivePoint:
    """Run a grid point live, without the common disturbance and with the seeds of draw 0.

    Raises:
        NoackError: the run could not be started or completed.
    """
    places = {
        (one.point.labels[POLICY], one.point.labels[LOOPS]): one
        for one in found if one.point.labels.get(DISTURBANCE, OWN) == OWN
    }  # fmt: skip
    policy, count = chosen
    return _live_point(places[policy, str(count)], folder)


def _live_point(found: GridPointResult, folder: Path) -> LivePoint:
    point, work = found.point, found.point.work
    assert isinstance(work, SharedNetworkWork)
    name = f"{point.labels[POLICY]}-{point.labels[LOOPS]}"
    scenario = point.scenario.model_copy(update={"seeds": seeds_of(work.seed, 0), "name": name})
    outcome = finalize(launch(scenario, folder), report=False, view=False)
    rows = np.zeros(1, work.row_type)
    work.measure_loops(load_run(outcome.run_dir).loops, rows[0])
    columns = {column: rows[column] for column in work.row_type.names or ()}
    values = {key: float(value[0]) for key, value in measured(columns, None).items()}
    judged: list[Metric] = ["transmissions", *LIMITS.values()]
    return LivePoint(
        point.labels[POLICY], int(point.labels[LOOPS]), outcome.run_dir, int(outcome.status),
        outcome.reason, sum(one.unintended_losses for one in outcome.summary.loops),
        {metric: values[metric] for metric in [*judged, "delay_max_s"]},
        {metric: prediction_interval(found.estimates[metric]) for metric in judged},
    )  # fmt: skip


def prediction_interval(one: Estimate) -> tuple[float, float]:
    """Return the 95 % prediction interval of a further draw; infinite from fewer than two draws."""
    if one.finite < 2:
        return -math.inf, math.inf
    halfwidth = one.halfwidth * math.sqrt(one.finite + 1)
    return one.mean - halfwidth, one.mean + halfwidth
