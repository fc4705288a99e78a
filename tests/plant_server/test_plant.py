"""The plant: the watchdog of the last actuation. Its disturbances are in tests/noack/disturbances/,
whole runs in tests/cosim/simulation/test_whole_loop.py."""

from pathlib import Path

import pytest

from cosim.analysis.ideal_loop import ideal_loop_part
from cosim.analysis.replay import replay
from cosim.analysis.summary.loop_summary import summarise_loop
from cosim.record.run_record import RunRecord
from tests.cosim.simulation.outage import CASES, POLICIES, at_the_end, with_outage
from tests.helpers.shipped import resolved

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(scope="module", params=["hold", "zero", "model"])
def run(request: pytest.FixtureRequest) -> RunRecord:
    """The controller stands still from 1 s to 1.4 s; its last tick before that is at 0.999 s."""
    changes = [f"plant.watchdog.policy={request.param}", "horizon_s=2"]
    return with_outage(resolved("lane_following", *changes), 1.0, 1.4)


def test_a_trip_before_the_first_actuation_is_in_the_summary() -> None:
    run = with_outage(resolved("lane_following", "horizon_s=2"), 0.0, 0.4)
    assert next(notice["t_ns"] for notice in run.notices if notice["level"] == "watchdog") == 102_000_000
    watchdog = summarise_loop(run, 0, "horizon").watchdog
    assert (watchdog.trips, watchdog.first_s) == (1, pytest.approx(0.102))


def test_the_beginning_and_end_of_a_trip_are_reported_and_replayed(run: RunRecord) -> None:
    trips = [(notice["t_ns"], notice["process"]) for notice in run.notices if notice["level"] == "watchdog"]
    assert trips == [(1_100_000_000, "plant"), (1_402_000_000, "plant")]
    policy = run.scenario.plant.watchdog.policy
    summary = summarise_loop(run, 0, "horizon")
    assert summary.to_json()["watchdog"] == {
        "policy": policy, "timeout_s": pytest.approx(0.1), "trips": 1,
        "first_s": pytest.approx(1.1), "total_s": pytest.approx(0.302),
    }  # fmt: skip
    assert replay(run).bit_exact
    why = None if policy == "hold" else "the watchdog replaced the input"
    assert ideal_loop_part(run, summary).reason == why


def test_the_table_in_the_documentation_is_the_simulated_one() -> None:
    """One number is simulated again; `python -m tests.cosim.simulation.outage` prints all rows."""
    lines = (DOCS / "network.md").read_text().splitlines()
    rows = [
        [line for line in lines if line.startswith(f"| `{name}`, `{mode}` | {lasts_s:g} s |")]
        for name, mode, lasts_s in CASES
    ]
    assert [len(row) for row in rows] == [1] * len(CASES)
    name, mode, lasts_s = CASES[4]
    held = rows[4][0].split(" | ")[2 + POLICIES.index("hold") + 1]
    assert held == f"{at_the_end(name, mode, 'hold', lasts_s):.2g}"
