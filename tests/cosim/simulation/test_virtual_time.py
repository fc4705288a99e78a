"""Runs in virtual time: bit for bit those of the plain driver in Python; violations; long runs."""

from typing import Any

import pytest

from cosim.analysis.summary.loop_summary import summarise_loop
from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import VirtualRun, simulate
from netem.core.packet_rows import NETEM_PACKET
from noack.core.core_library import ffi, new_handle
from noack.machines.run_channel import channel_of
from noack.protocol.record_tables import CONTROLLER_DELIVERY
from noack.scenario.resolution import ResolvedRun, resolve
from noack.scenario.scenario_file import validate
from tests.cosim.simulation.event_scheduler import record_of_run
from tests.helpers.shipped import resolved
from tests.oracles.random_scenarios import POLICIES, random_scenario


def require_equal(record: RunRecord, expected: RunRecord) -> None:
    for table in expected.tables:
        assert record[table].dtype == expected[table].dtype
        assert record[table].tobytes() == expected[table].tobytes(), table
    assert record.reports == expected.reports
    assert record.notices == expected.notices


@pytest.mark.parametrize("number", range(len(POLICIES)))
def test_random_loops_run_as_by_the_plain_driver(number: int) -> None:
    scenario = resolve(validate(random_scenario(number), "random"))
    require_equal(simulate(scenario), record_of_run(scenario))


@pytest.mark.sanitized
def test_a_scripted_network_decides_as_in_the_plain_driver() -> None:
    scenario = resolved("unstable_pendulum", "horizon_s=3.0")

    def decide(data: bytes, now_ns: int) -> int | None:
        return None if data[16] % 3 == 1 else now_ns % 70_000_000

    require_equal(simulate(scenario, decide), record_of_run(scenario, decide))


@pytest.mark.sanitized
def test_numbers_of_no_simulation_are_refused() -> None:
    scenario = resolved("unstable_pendulum", "horizon_s=1.0")
    run, wire = VirtualRun(ResolvedRun(scenario, (scenario,))), ffi.new("noack_wire *")
    processes = [machines.core for machines in run.machines.values()]
    two = channel_of(scenario, loops=2)
    for roles, channel, directions in (
        (processes, two, [0] * 5),
        (processes[::-1], run.channel, [0] * 5),
        (processes, run.channel, [0, 0, 1, 0, 0]),
    ):
        with pytest.raises(ValueError, match="simulation: "):
            new_handle("simulation", roles, channel.core, wire, directions)


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
    violations = summarise_loop(record, 0, "horizon").to_json()["violations"]
    assert len(violations) == len(long_gaps) > 0
    for violation, gap in zip(violations, long_gaps, strict=True):
        assert violation["t_s"] == pytest.approx(gap["t_ns"] * 1e-9)
        assert violation["process"] == "controller"
        lost = "1 loss" if gap["dropouts"] == 1 else f"{gap['dropouts']} consecutive losses"
        assert f"MANSD violated: {lost} before" in violation["what"]


def test_each_packet_of_a_long_run_is_recorded_once_and_progress_is_reported(
    busy_content: dict[str, Any],
) -> None:
    """The network's memory for rows is full three times."""
    busy_content["trigger"] = {"policy": "periodic", "period_s": 0.01}
    busy_content["horizon_s"] = 150.0
    reported: list[tuple[float, float]] = []
    record = simulate(
        resolve(validate(busy_content, "test")),
        progress=lambda done, total=1.0, /: reported.append((done, total)),
    )
    assert record[NETEM_PACKET]["input"].tolist() == list(range(15_001))
    assert len(reported) > 2
    assert reported == sorted(reported)
    assert 0 <= reported[0][0] < reported[-1][0] <= 150.0
    assert {total for _, total in reported} == {150.0}
