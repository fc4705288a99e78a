"""The process that sends the flood, and the figures of a flooded run."""

import subprocess

import numpy as np
import pytest

from benchmarks.bare_programs import Flood, command_of
from benchmarks.faults import FaultedRun, figures_of, recovery_s
from cosim.cli import find_scenario
from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import simulate
from noack.protocol.record_tables import CONTROLLER_STEP, PLANT_STEP, SENSOR_MEASUREMENT
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load
from tests.cosim.record.changed_records import changed, copied

PERIOD_NS = 2_000_000


def test_the_flood_process_prints_the_number_sent() -> None:
    done = subprocess.run(
        command_of("flood", 0.05, 0, 9), capture_output=True, text=True, check=True
    )
    assert '"sent": ' in done.stdout


@pytest.fixture(scope="module")
def record() -> RunRecord:
    settings = ["horizon_s=4", "ports={}"]
    return simulate(resolve(load(find_scenario("lane_following"), settings)))


def test_the_effects_of_a_flood_are_read_from_the_record(record: RunRecord) -> None:
    rows = copied(record)
    for table in (PLANT_STEP, CONTROLLER_STEP, SENSOR_MEASUREMENT):
        rows[table]["now_ns"] = rows[table]["t_ns"] + 50_000
    steps, received = rows[PLANT_STEP], rows[SENSOR_MEASUREMENT]
    during = (steps["t_ns"] > 1_000_000_000) & (steps["t_ns"] < 2_000_000_000)
    steps["now_ns"][during] += 7_000_000
    after = (steps["t_ns"] >= 2_000_000_000) & (steps["t_ns"] < 2_040_000_000)
    steps["now_ns"][after] += 3_000_000
    rows[SENSOR_MEASUREMENT] = np.delete(received, [600, 601, 602])
    flooded = changed(record, rows, reports={})
    run = FaultedRun(flooded, {"unintended_losses": 5}, 100.0, Flood(101.0, 102.0, 12_345), None)
    last_late_ns = 2_040_000_000 - PERIOD_NS + 3_050_000
    back_ms = 1e-6 * last_late_ns - 2000.0
    expected = (12_345.0, 3, 5, 50.0, 7050.0, back_ms)
    assert tuple(figures_of(run).values()) == pytest.approx(expected)


def test_a_late_step_long_after_the_flood_does_not_count() -> None:
    assert recovery_s(np.array([]), 2.0) == 0.0
    assert recovery_s(np.array([1.9, 2.1, 2.3, 3.0]), 2.0) == pytest.approx(0.3)
    assert recovery_s(np.array([1.9, 2.5]), 2.0) == 0.0
