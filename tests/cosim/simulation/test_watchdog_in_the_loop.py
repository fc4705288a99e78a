"""A controller that stands still in virtual time, and the plant's input meanwhile."""

from pathlib import Path

import pytest

from cosim.analysis.fidelity import IncomparableError, live_run
from cosim.analysis.replay import replay
from cosim.analysis.run_summary import summarise
from cosim.output.run_tables import key_numbers
from cosim.record.run_record import RunRecord
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load
from tests.cosim.live.outage import CASES, SCENARIOS, row, with_outage
from tests.cosim.summaries import summary_of

DOCS = Path(__file__).parents[3] / "docs"


@pytest.fixture(scope="module", params=["hold", "zero", "model"])
def run(request: pytest.FixtureRequest) -> RunRecord:
    """The controller stands still from 1 s to 1.4 s; its last tick before that is at 0.999 s."""
    changes = [f"plant.watchdog.policy={request.param}", "horizon_s=2"]
    return with_outage(resolve(load(SCENARIOS / "lane_following.toml", changes)), 1.0, 1.4)


def test_a_run_with_an_outage_is_replayed_bit_for_bit(run: RunRecord) -> None:
    found = replay(run)
    assert found.bit_exact, found.first_difference
    assert found.gaps == []


def test_the_beginning_and_end_of_a_trip_are_reported(run: RunRecord) -> None:
    trips = [(one["t_ns"], one["process"]) for one in run.notices if one["level"] == "watchdog"]
    assert trips == [(1_100_000_000, "plant"), (1_402_000_000, "plant")]
    summary = summarise(run, 0, "horizon").to_json()
    assert summary["watchdog"] == {
        "policy": run.scenario.plant.watchdog.policy, "timeout_s": pytest.approx(0.1), "trips": 1,
        "first_s": pytest.approx(1.1), "total_s": pytest.approx(0.302),
    }  # fmt: skip
    shown = dict(key_numbers(summary_of(run)))
    assert shown["watchdog: newest actuation too old"] == (
        "once, first at 1.100 s, 0.302 s in total"
    )


def test_the_watchdogs_input_is_not_compared_with_the_ideal_loop(run: RunRecord) -> None:
    if run.scenario.plant.watchdog.policy == "hold":
        live_run(run)
        return
    with pytest.raises(IncomparableError, match="no watchdog and no safe input"):
        live_run(run)


def test_the_table_in_the_documentation_is_the_simulated_one() -> None:
    """One row is simulated again; `python -m tests.cosim.live.outage` prints all rows."""
    text = (DOCS / "scenarios.md").read_text()
    assert row(*CASES[4]) in text.splitlines()
    for name, mode, lasts_s in CASES:
        assert f"| `{name}`, `{mode}` | {lasts_s:g} s |" in text
