"""What limits the number of loops: against R h / bits, the cost of a kind, normal draws."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.studies.campaign.campaign_grid import grid
from cosim.studies.campaign.campaign_summary import summarise
from cosim.studies.campaign.campaign_workers import run_in_process
from cosim.studies.campaign.chunk_store import Store, run_campaign
from cosim.studies.campaign.metrics import estimate
from cosim.studies.capacity.capacity_page import CapacityResult
from cosim.studies.capacity.capacity_plan import CapacityPlan
from cosim.studies.capacity.capacity_result import (
    PolicyCapacity,
    capacities,
    capacity_of,
    prediction_interval,
)
from cosim.studies.capacity.loop_kinds import kinds_of, policies_of
from noack.scenario.scenario_file import load
from tests.cosim.studies.capacity.conftest import FILE, LOOP, PERIOD_S, plan_of

BITS = 8 * (28 + 64)
"""Bits of an update of two states on the link: UDP and IPv4, and the datagram of docs/wire.md."""


def study(tmp_path: Path, queue: int, deadline_s: float = PERIOD_S) -> CapacityResult:
    """Periodic loops on a link that carries the updates of exactly six."""
    rate_bps = round(6 / PERIOD_S * BITS)
    stage = f"network.impairments=[{{ kind = 'rate', rate_bps = {rate_bps}, queue = {queue} }}]"
    scenario = load(FILE, [stage, "network.loss.probability=0.0", "horizon_s=3.0", LOOP])
    settings = {
        "horizon_s": 3.0,
        "network.impairments": [{"kind": "rate", "rate_bps": rate_bps, "queue": queue}],
        "network.loss.probability": 0.0,
        "certificate.network_delay_s": deadline_s,
    }
    kinds = kinds_of(scenario, PERIOD_S)
    plan = CapacityPlan(
        scenario, kinds, FILE, settings, deadline_s, (1, 6, 7),
        {"periodic": policies_of(kinds)["periodic"]}, 0.0, 2, 5,
    )  # fmt: skip
    campaign = plan.campaign()
    store = Store(tmp_path, grid(campaign, Path("study")), plan.draws, 1)
    run_campaign(store, run_in_process)
    summary = summarise(campaign, store)
    return CapacityResult(plan, summary, capacities(plan, summary, store), [])


def limits_of(result: CapacityResult) -> tuple[PolicyCapacity, dict[str, float]]:
    (policy_capacity,) = result.capacities
    return policy_capacity, {name: limit.median for name, limit in policy_capacity.limits.items()}


def test_a_queue_carries_as_many_periodic_loops_as_the_rate_allows(tmp_path: Path) -> None:
    policy_capacity, limits = limits_of(study(tmp_path / "long", queue=100))  # it delays, and drops nothing
    assert policy_capacity.any_limit.median == limits["deadline"] == 6
    assert limits["guarantee"] == np.inf
    result = study(tmp_path / "short", queue=6, deadline_s=2 * PERIOD_S)
    assert result.plan.periodic_loops == pytest.approx(6.0, rel=1e-6)
    policy_capacity, limits = limits_of(result)
    # The seventh loop overflows the queue of six, in which updates wait for about a period.
    assert policy_capacity.any_limit.median == limits["guarantee"] == 6
    assert limits["deadline"] == np.inf
    assert policy_capacity.limited_by == "guarantee"


def test_a_policy_must_keep_the_cost_of_each_kind_of_loop() -> None:
    """Kind b costs a hundred times as much as a; a alone doubles its cost in the mixture."""
    plan = plan_of("loops=[{ name = 'a' }, { name = 'b' }]", (2, 4))
    quiet = {"loops_guarantee_used": np.zeros(3), "updates_late": np.zeros(3)}

    def runs(a: float, b: float) -> dict[str, Any]:
        return quiet | {"cost_of_a": np.full(3, a), "cost_of_b": np.full(3, b)}

    own = {"2 unshared": runs(1.0, 100.0), "4 unshared": runs(1.0, 90.0)}
    policy_capacity = capacity_of(plan, "model", "own", {"2": runs(1.9, 110.0), "4": runs(2.1, 110.0)} | own)
    assert (policy_capacity.any_limit.median, policy_capacity.limited_by) == (2, "cost")


def test_95_of_100_further_draws_are_in_the_prediction_interval() -> None:
    """Of normal values; their number is within four standard deviations."""
    draws = np.random.default_rng(4).normal(3.0, 2.0, (4000, 5))
    ends = np.array([prediction_interval(estimate(draw[:4])) for draw in draws])
    inside = (ends[:, 0] <= draws[:, 4]) & (draws[:, 4] <= ends[:, 1])
    assert inside.mean() == pytest.approx(0.95, abs=4 * math.sqrt(0.95 * 0.05 / len(draws)))
    assert prediction_interval(estimate(draws[0, :1])) == (-math.inf, math.inf)
