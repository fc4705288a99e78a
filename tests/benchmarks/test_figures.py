"""Benchmarks: figures from given measurements, programs, and the guarantee with few decisions."""

import subprocess
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.bare_programs import Flood, command_of
from benchmarks.faults import FaultedRun, figures_of, recovery_s
from benchmarks.guarantees import (
    COMBINATIONS,
    REORDERING,
    Decider,
    check_row,
    loop_named,
    row_of,
    triggers,
)
from cosim.analysis.adversary import Objective, find_worst
from cosim.cli import find_scenario
from cosim.simulation.virtual_time import simulate
from noack.protocol.record_tables import CONTROLLER_STEP, PLANT_STEP, SENSOR_MEASUREMENT
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load
from noack.scenario.sections import POLICIES
from tests.cosim.record.changed_records import changed, copied
from tests.oracles.receiver import Limits, outcomes_of, violations


def test_the_effects_of_a_flood_are_read_from_the_record() -> None:
    record = simulate(resolve(load(find_scenario("lane_following"), ["horizon_s=4", "ports={}"])))
    flood = command_of("flood", 0.05, 0, 9)
    sent = subprocess.run(flood, capture_output=True, text=True, check=True).stdout
    assert '"sent": ' in sent
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
    last_late_ns = 2_040_000_000 - 2_000_000 + 3_050_000
    back_ms = 1e-6 * last_late_ns - 2000.0
    expected = (12_345.0, 3, 5, 50.0, 7050.0, back_ms)
    assert tuple(figures_of(run).values()) == pytest.approx(expected)
    # A late step long after the flood does not count.
    assert recovery_s(np.array([]), 2.0) == 0.0
    assert recovery_s(np.array([1.9, 2.1, 2.3, 3.0]), 2.0) == pytest.approx(0.3)
    assert recovery_s(np.array([1.9, 2.5]), 2.0) == 0.0


# --- the guarantee --------------------------------------------------------------------------------


@pytest.mark.parametrize("words", COMBINATIONS)
def test_no_combination_is_violated_and_each_would_be_without_it(words: str) -> None:
    for before in ("loss 50%", f"loss 30% {REORDERING}"):
        row = check_row(f"{before} {words}", COMBINATIONS[words], 1_000_000)
        assert row.value == 0
        free = outcomes_of(Decider(f"{before} limit 1000000").decide())
        assert violations(free, COMBINATIONS[words]) > 1000


def test_the_check_counts_windows_and_gaps() -> None:
    lost = np.array([1, 1, 0, 1, 0, 0, 1, 0, 0, 0], bool)
    assert violations(lost, Limits(((1, 2),))) == 1
    assert violations(lost, Limits(((2, 4),))) == 1  # of the first four, three are lost
    assert violations(lost, Limits((), 2)) == 1
    assert violations(lost, Limits(((2, 3),), 1)) == 0


def test_every_policy_that_is_a_rule_is_compared() -> None:
    paper = {"beta": 0.5, "alpha_per_s": 0.25, "floor": 0.0}
    found = triggers(paper, np.eye(2)).values()
    names = {one["policy"] for one in found} | {
        one["rule"]["policy"] for one in found if "rule" in one
    }
    assert names == {name for name, made in POLICIES.items() if made.example(2) is not None}


def test_a_bound_below_the_worst_run_is_reported() -> None:
    loop = loop_named("double_integrator", 2.0, "identity")
    worst = find_worst(loop, Objective.ERROR, beam=0)
    assert worst.certified is not None
    assert worst.value is not None
    row = row_of("double_integrator", worst)
    assert row.holds
    assert 0.1 < (row.value or 0.0) < 1.0
    assert row_of("", replace(worst, certified=worst.value * 0.99)).holds is False
