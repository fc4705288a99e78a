"""Simulated runs against hand calculation and each other; more in integration/test_run.py."""

from typing import Any

import numpy as np
import pytest

from cosim.analysis.run_summary import summarise
from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import RowMemory, simulate
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    NETEM_PACKET,
    SENSOR_MEASUREMENT,
)
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate

MS = 1_000_000


@pytest.fixture
def busy_content(content: dict[str, Any]) -> dict[str, Any]:
    """Dozens of events, half of them lost, and a plant that differs from the model."""
    mismatch = {"draw": "uniform", "uncertainty_A": [[0.0, 0.0], [0.5, 0.5]]}
    content["horizon_s"] = 4.0
    content["plant"] |= {"rate_hz": 100.0} | mismatch
    content["controller"] = {"rate_hz": 100.0}
    content["trigger"]["beta"] = 0.01
    return content


@pytest.fixture
def busy(busy_content: dict[str, Any]) -> Scenario:
    return resolve(validate(busy_content, "test"))


def equal(one: RunRecord, other: RunRecord) -> bool:
    return all(one[table].tobytes() == other[table].tobytes() for table in one.tables)


def test_a_perfect_network_is_the_lossless_one(busy_content: dict[str, Any]) -> None:
    busy_content["network"]["loss"] = {"model": "lossless"}
    lossless = resolve(validate(busy_content, "test"))
    assert equal(simulate(lossless), simulate(lossless, lambda data, now_ns: 0))


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


def test_progress_is_reported_during_a_run(busy: Scenario) -> None:
    reported_ns: list[int] = []
    longer = busy.model_copy(update={"horizon_s": 25.0})
    simulate(longer, progress=reported_ns.append)
    assert len(reported_ns) > 2
    assert reported_ns == sorted(reported_ns)
    assert 0 <= reported_ns[0] < reported_ns[-1] <= longer.timing.horizon_ns


def test_each_packet_of_a_long_run_is_recorded_once(busy_content: dict[str, Any]) -> None:
    """The network's memory for rows is full three times."""
    busy_content["trigger"] = {"policy": "periodic", "period_s": 0.01}
    busy_content["horizon_s"] = 150.0
    record = simulate(resolve(validate(busy_content, "test")))
    assert record[NETEM_PACKET]["input"].tolist() == list(range(15_001))


def test_no_two_tables_share_memory() -> None:
    memory, wide = RowMemory(), np.dtype([("a", "<u2"), ("b", "<f8", (1000,))])
    tables = [memory.rows(places, wide) for places in (10, 1500, 1500, 1, 5000)]
    assert [rows.shape for rows in tables] == [(10,), (1500,), (1500,), (1,), (5000,)]
    for number, rows in enumerate(tables):
        rows["b"] = number
    assert all((rows["b"] == number).all() for number, rows in enumerate(tables))
