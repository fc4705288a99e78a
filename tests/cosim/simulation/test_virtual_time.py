"""Simulated runs: violations, long runs, and a controller that stands still."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.analysis.fidelity import IncomparableError, live_run
from cosim.analysis.replay import replay
from cosim.analysis.run_summary import summarise
from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import RowMemory, simulate
from noack.protocol.record_tables import CONTROLLER_DELIVERY, NETEM_PACKET, SENSOR_MEASUREMENT
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load, validate
from tests.cosim.live.outage import CASES, SCENARIOS, row, with_outage


@pytest.fixture
def busy_content(content: dict[str, Any]) -> dict[str, Any]:
    """Dozens of events, half of them lost, and a plant that differs from the model."""
    mismatch = {"draw": "uniform", "uncertainty_A": [[0.0, 0.0], [0.5, 0.5]]}
    content["horizon_s"] = 4.0
    content["plant"] |= {"rate_hz": 100.0} | mismatch
    content["controller"] = {"rate_hz": 100.0}
    content["trigger"]["beta"] = 0.01
    return content


def test_the_controller_reports_a_violated_assumption(busy_content: dict[str, Any]) -> None:
    busy_content["network"] |= {"mansd": 0, "enforce_mansd": False}
    record = simulate(resolve(validate(busy_content, "test")))
    assert record.notices
    assert {notice["process"] for notice in record.notices} == {"controller"}
    assert {notice["level"] for notice in record.notices} == {"violation"}
    deliveries = record[CONTROLLER_DELIVERY]
    long_gaps = deliveries[deliveries["dropouts"] > 0]
    violations = summarise(record, 0, "horizon").to_json()["assumption_violations"]
    assert len(violations) == len(long_gaps) > 0
    for violation, gap in zip(violations, long_gaps, strict=True):
        assert violation["t_s"] == pytest.approx(gap["t_ns"] * 1e-9)
        assert violation["process"] == "controller"
        assert f"{gap['dropouts']} successive dropouts" in violation["what"]


def test_a_violation_without_a_later_delivery_is_reported(busy_content: dict[str, Any]) -> None:
    loss = {"model": "worst_case"}
    busy_content["network"] = {"mansd": 2, "enforce_mansd": False, "loss": loss}
    record = simulate(resolve(validate(busy_content, "test")))
    summary = summarise(record, 0, "horizon").to_json()
    (violation,) = summary["assumption_violations"]
    events = record[SENSOR_MEASUREMENT]
    event_ns = events["t_ns"][events["event"] >= 0]
    # t_0 is delivered; two losses are allowed
    assert violation["t_s"] == pytest.approx(event_ns[3] * 1e-9)
    assert summary["longest_loss_burst"] == len(event_ns) - 1 > 2


def test_each_packet_of_a_long_run_is_recorded_once_and_progress_is_reported(
    busy_content: dict[str, Any],
) -> None:
    """The network's memory for rows is full three times."""
    busy_content["trigger"] = {"policy": "periodic", "period_s": 0.01}
    busy_content["horizon_s"] = 150.0
    reported_ns: list[int] = []
    record = simulate(resolve(validate(busy_content, "test")), progress=reported_ns.append)
    assert record[NETEM_PACKET]["input"].tolist() == list(range(15_001))
    assert len(reported_ns) > 2
    assert reported_ns == sorted(reported_ns)
    assert 0 <= reported_ns[0] < reported_ns[-1] <= record.scenario.timing.horizon_ns


def test_no_two_tables_share_memory() -> None:
    memory, wide = RowMemory(), np.dtype([("a", "<u2"), ("b", "<f8", (1000,))])
    tables = [memory.rows(places, wide) for places in (10, 1500, 1500, 1, 5000)]
    assert [rows.shape for rows in tables] == [(10,), (1500,), (1500,), (1,), (5000,)]
    for number, rows in enumerate(tables):
        rows["b"] = number
    assert all((rows["b"] == number).all() for number, rows in enumerate(tables))


# --- a controller that stands still ---------------------------------------------------------------


DOCS = Path(__file__).parents[3] / "docs"


@pytest.fixture(scope="module", params=["hold", "zero", "model"])
def run(request: pytest.FixtureRequest) -> RunRecord:
    """The controller stands still from 1 s to 1.4 s; its last tick before that is at 0.999 s."""
    changes = [f"plant.watchdog.policy={request.param}", "horizon_s=2"]
    return with_outage(resolve(load(SCENARIOS / "lane_following.toml", changes)), 1.0, 1.4)


def test_the_beginning_and_end_of_a_trip_are_reported_and_replayed(run: RunRecord) -> None:
    trips = [(one["t_ns"], one["process"]) for one in run.notices if one["level"] == "watchdog"]
    assert trips == [(1_100_000_000, "plant"), (1_402_000_000, "plant")]
    policy = run.scenario.plant.watchdog.policy
    assert summarise(run, 0, "horizon").to_json()["watchdog"] == {
        "policy": policy, "timeout_s": pytest.approx(0.1), "trips": 1,
        "first_s": pytest.approx(1.1), "total_s": pytest.approx(0.302),
    }  # fmt: skip
    assert replay(run).bit_exact
    if policy == "hold":
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
