"""Campaigns over the number of loops on one network."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.analysis.run_summary import summarise
from cosim.simulation.virtual_time import simulate_loops
from cosim.studies.campaign.campaign_grid import grid, row_type
from cosim.studies.campaign.random_draws import seeds_of
from cosim.studies.campaign.sampled_draws import LOOPS_ROW, SharedNetworkWork, in_virtual_time
from noack.core.errors import CallerError
from noack.scenario.scenario_file import load
from tests.cosim.studies.campaign.conftest import Write

SCENARIO = Path(__file__).parents[4] / "scenarios" / "shared_bottleneck.toml"
AXIS = {"name": "number", "key": "loops", "values": [1, 3]}


def work(*overrides: str, **settings: Any) -> SharedNetworkWork:
    scenario = in_virtual_time(load(SCENARIO, ["horizon_s=2.0", *overrides]))
    measured: dict[str, Any] = {"Q": None, "R": None, "settle": 0.5, "most_events": 1000}
    return SharedNetworkWork(scenario, 7, **measured | settings)


def test_a_row_agrees_with_the_summaries_of_the_loops() -> None:
    one = work("network.impairments=[]", judges=True)
    rows = one.run(range(2))
    assert rows.dtype == LOOPS_ROW
    seeds = seeds_of(one.seed, 1)
    shared = simulate_loops(one.scenario.model_copy(update={"seeds": seeds}))
    loops = [summarise(record, 0, "").to_json() for record in shared.loops]
    row = rows[1]
    assert row["transmissions"] == sum(loop["events"] for loop in loops) != rows[0]["transmissions"]
    assert row["deliveries"] == sum(loop["deliveries"] for loop in loops)
    assert row["longest_loss_burst"] == max(loop["longest_loss_burst"] for loop in loops)
    assert row["final_norm"] == pytest.approx(max(loop["final_state_norm"] for loop in loops))
    assert 0 < row["cost"] < row["cost_worst"]
    assert row["loops_failed"] == 0
    assert 0 <= row["loops_claims_held"] <= 1


def test_a_loop_that_diverges_costs_an_infinite_amount_and_is_counted() -> None:
    own = "A = [[0.0, 1.0], [900.0, 0.0]], B = [[0.0], [1.0]]"
    wild = f'{{ name = "wild", plant = {{ draw = "given", {own} }} }}'
    one = work("horizon_s=30", f'loops=[{{ name = "calm", count = 3 }}, {wild}]', most_events=400)
    (row,) = one.run(range(1))
    assert row["loops_failed"] == 0.25
    assert np.isnan(row["cost"])
    assert np.isnan(row["loops_claims_held"])


def test_the_number_of_loops_is_an_axis(write: Write, plan: dict[str, Any]) -> None:
    sampled: dict[str, Any] = {"time": "sampled", "compare": None, "figures": []}
    _, points = _points(write(plan, axes=[AXIS], **sampled))
    assert [point.scenario.loops[0].count for point in points] == [1, 3]
    assert row_type(points) == LOOPS_ROW
    assert [type(point.work) for point in points] == [SharedNetworkWork, SharedNetworkWork]
    with pytest.raises(CallerError, match='needs time = "sampled"'):
        _points(write(plan, axes=[AXIS], **sampled | {"time": "continuous"}))
    some = {"name": "some", "variants": {"one": {"mode": "zoh"}, "two": {"loops": 2}}}
    with pytest.raises(CallerError, match="either all grid points have loops, or none has"):
        _points(write(plan, axes=[some], **sampled))


def test_different_loops_keep_their_proportions(write: Write, plan: dict[str, Any]) -> None:
    """The number of loops applies after all other settings."""
    loops = [{"name": "a", "count": 4}, {"name": "b", "count": 2, "mode": "zoh"}]
    sampled: dict[str, Any] = {"time": "sampled", "compare": None, "figures": []}

    def axes(*numbers: int) -> list[dict[str, Any]]:
        variants = {f"v{value}": {"loops": value} for value in numbers}
        own = {"slow": {"loops.1.plant": {"initial_state": [2.0, 0.0]}}, "same": {"loops": loops}}
        return [{"name": "number", "variants": variants}, {"name": "own", "variants": own}]

    settings = {"loops": loops}
    _, points = _points(write(plan, axes=axes(3, 9), settings=settings, **sampled))
    found = [[(one.name, one.count) for one in point.scenario.loops] for point in points[::2]]
    assert found == [[("a", 2), ("b", 1)], [("a", 6), ("b", 3)]]
    assert points[0].scenario.loops[1].plant == {"initial_state": [2.0, 0.0]}
    rows = points[0].work.run(range(1))
    assert row_type(points) == rows.dtype
    mean = (2 * rows["cost_of_a"] + rows["cost_of_b"]) / 3
    assert rows["cost"] == pytest.approx(mean, rel=1e-12)
    with pytest.raises(CallerError, match="should be a multiple of 3"):
        _points(write(plan, axes=axes(3, 4), settings=settings, **sampled))


def _points(path: Path) -> tuple[Any, Any]:
    from cosim.studies.campaign.campaign_file import load as load_campaign

    campaign = load_campaign(path)
    return campaign, grid(campaign, path)
