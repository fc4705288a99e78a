"""Simulated runs against hand calculation and each other; more in integration/test_run.py."""

import itertools
from typing import Any

import numpy as np
import pytest

from cosim.analysis.run_summary import summarise
from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import RowMemory, simulate
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    NETEM_PACKET,
    PLANT_ACTUATION,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
    Fate,
)
from noack.protocol.wire_format import read_header
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


def test_the_record_depends_on_the_scenario_but_not_on_its_speed(busy: Scenario) -> None:
    assert equal(simulate(busy), simulate(busy.model_copy(update={"speed": 50.0})))


def test_every_step_occurs_and_is_on_time(busy: Scenario) -> None:
    record = simulate(busy)
    for table, period_ns, phase_ns in (
        (PLANT_STEP, 10 * MS, 0),
        (SENSOR_MEASUREMENT, 10 * MS, 0),
        (CONTROLLER_STEP, 10 * MS, 5 * MS),
    ):
        due = np.arange(phase_ns, busy.timing.horizon_ns + 1, period_ns)
        np.testing.assert_array_equal(record[table]["t_ns"], due)
        np.testing.assert_array_equal(record[table]["now_ns"], due)
    assert len(record[PLANT_ACTUATION]) == len(record[CONTROLLER_STEP])
    # The input of a tick half a period after a step applies from the next step on.
    np.testing.assert_array_equal(
        record[PLANT_STEP]["actuation"], np.arange(len(record[PLANT_STEP])) - 1
    )
    events = record[SENSOR_MEASUREMENT]["event"]
    assert (events >= 0).sum() > 20
    summary = summarise(record, 0, "horizon").to_json()
    assert summary["missing_samples"] == summary["unintended_losses"] == 0
    assert summary["identity_residual_relative"] < 1e-12


def test_a_given_network_decides_losses_and_delays(busy: Scenario) -> None:
    """Every third update is lost; the others take 0, 7, 14, … ms in turn, some out of order."""
    delays_ms = [None if i % 3 == 2 else 7 * (i % 5) for i in range(1000)]
    asked: list[int] = []

    def network(data: bytes, now_ns: int) -> int | None:
        header = read_header(data)
        assert header is not None
        assert header.t_ns == now_ns
        asked.append(header.sequence)
        delay_ms = delays_ms[header.sequence]
        return None if delay_ms is None else delay_ms * MS

    record = simulate(busy, network)
    packets, deliveries = record[NETEM_PACKET], record[CONTROLLER_DELIVERY]
    assert asked == list(range(len(packets)))
    np.testing.assert_array_equal(
        packets["fate"] == Fate.DROPPED, [delays_ms[i] is None for i in asked]
    )
    runs = [len(list(run)) for lost, run in itertools.groupby(packets["fate"]) if lost]
    assert packets["consecutive_losses"].max() == max(runs) == 1
    sequence = deliveries["sequence"]
    late_ms = (deliveries["now_ns"] - deliveries["t_ns"]) // MS
    np.testing.assert_array_equal(late_ms, [delays_ms[i] for i in sequence])
    # Updates delivered out of order are stale; all others are used.
    arrival_ms = {
        i: packets["t_ns"][i] // MS + delay for i in asked if (delay := delays_ms[i]) is not None
    }
    newest_first = [
        i for i, at in arrival_ms.items()
        if not any(j > i and other < at for j, other in arrival_ms.items())
    ]  # fmt: skip
    stale = record.reports["controller"]["channel"]["rejected"].get("stale", 0)
    assert len(sequence) + stale == len(arrival_ms)
    assert set(sequence) >= set(newest_first)


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


def test_a_diverging_loop_is_recorded(content: dict[str, Any]) -> None:
    """ẋ = 2000 x: e^(2000 t) soon overflows; non-finite values are not received."""
    content["model"] = {"A": [[2000.0]], "B": [[1.0]], "gain": [[-1.0]], "allow_unstable": True}
    content["plant"] = {"initial_state": [1.0]}
    record = simulate(resolve(validate(content, "test")))
    assert not np.isfinite(record[PLANT_STEP]["x"]).all()
    assert record.reports["sensor"]["channel"]["rejected"]["not_finite"] > 0
    summary = summarise(record, 0, "horizon").to_json()
    assert summary["exit"]["status"] == 1
    assert 0.3 < summary["diverged_at_s"] < 0.4  # 709.8 / 2000: e^x overflows there


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
