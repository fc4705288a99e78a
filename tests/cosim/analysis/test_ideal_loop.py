"""The difference to the ideal loop, against the exact run of the scenario, and where there is none."""

import json
from pathlib import Path

import numpy as np
import pytest

import noack
from cosim.analysis.ideal_loop import IncomparableError, compare_with_ideal, ideal_loop_part
from cosim.analysis.summary.loop_summary import summarise_loop
from cosim.analysis.summary.summary_model import IdealLoopPart, NoIdealLoopPart
from cosim.record.run_record import RunRecord
from cosim.simulation.continuous import run_continuous
from cosim.simulation.virtual_time import simulate
from noack.protocol.record_tables import PLANT_STEP, SENSOR_MEASUREMENT
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load
from tests.cosim.record.changed_records import changed

LANE = Path(__file__).parents[3] / "scenarios" / "lane_following.toml"


def lane(*settings: str) -> RunRecord:
    return simulate(resolve(load(LANE, ["horizon_s=4", *settings])))


def part_of(record: RunRecord) -> IdealLoopPart | NoIdealLoopPart:
    return ideal_loop_part(record, summarise_loop(record, 0, "horizon"))


def compared(record: RunRecord) -> IdealLoopPart:
    part = part_of(record)
    assert isinstance(part, IdealLoopPart), part.reason
    return part


@pytest.fixture(scope="module")
def record() -> RunRecord:
    return lane("plant.rate_hz=100", "controller.rate_hz=100")


def test_the_difference_is_that_to_the_exact_run_with_the_same_losses(record: RunRecord) -> None:
    """The losses depend on the seed and the number of an update only."""
    exact = run_continuous(record.scenario)
    steps = record[PLANT_STEP]
    apart = np.linalg.norm(steps["x"] - exact.at(steps["t_ns"] * 1e-9).x, axis=1)
    part = compared(record)
    assert part.rms_difference == pytest.approx(np.sqrt(np.mean(apart**2)))
    assert part.rms_x == pytest.approx(np.sqrt(np.mean(np.linalg.norm(steps["x"], axis=1) ** 2)))
    assert part.events == len(exact.event_s)
    json.dumps(part.model_dump(), allow_nan=False)


def test_a_run_comes_closer_to_the_ideal_loop_with_shorter_periods() -> None:
    rates_hz = (50, 200, 800)
    runs = [compared(lane(f"plant.rate_hz={rate}", f"controller.rate_hz={rate}")) for rate in rates_hz]
    differences = [run.rms_difference for run in runs]
    assert 0 < differences[2] < 0.5 * differences[1] < 0.25 * differences[0]


def test_a_loop_at_rest_does_not_differ() -> None:
    part = compared(lane("plant.initial_state=[0.0, 0.0, 0.0, 0.0]", "plant.rate_hz=100"))
    assert (part.rms_difference, part.rms_x) == (0.0, 0.0)


def test_an_event_at_the_last_step_is_one_of_the_ideal_loop() -> None:
    """An update every 0.1 s: the run had 41, and the ideal loop was said to have 40."""
    record = lane('trigger={policy="periodic", period_s=0.1}', "plant.rate_hz=100", "controller.rate_hz=100")
    assert compared(record).events == len(record.events()) == 41


def test_the_ideal_loop_loses_what_the_run_lost() -> None:
    """The run's network loses nothing, whatever the emulator would have lost."""
    settings = ["horizon_s=4", "plant.rate_hz=100", "controller.rate_hz=100"]
    record = simulate(resolve(load(LANE, settings)), lambda data, now_ns: 0)
    lossless = run_continuous(resolve(load(LANE, [*settings, "network.loss.probability=0"])))
    assert compared(record).events == len(lossless.event_s) != len(run_continuous(record.scenario).event_s)


def test_events_that_accumulate_have_no_ideal_loop(
    record: RunRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cosim.analysis.ideal_loop._MORE_EVENTS", 3 - 2 * len(record.events()))
    with pytest.raises(IncomparableError, match=r"events accumulate \(more than 3\)"):
        compare_with_ideal(record, summarise_loop(record, 0, "horizon"))


def test_the_summary_says_why_a_run_is_not_compared(
    record: RunRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps = record[PLANT_STEP].copy()
    steps["x"][300:] = np.nan
    diverged = changed(record, {PLANT_STEP: steps})
    incomplete = changed(record, {SENSOR_MEASUREMENT: np.delete(record[SENSOR_MEASUREMENT], 50)})
    empty = changed(record, {PLANT_STEP: record[PLANT_STEP][:0]})
    nonlinear = simulate(resolve(noack.load("cart_pole", {"horizon_s": 0.1})))
    reasons = {
        "the run diverged": diverged,
        "the record is not complete": incomplete,
        "plant.system": nonlinear,
    }
    for reason, run in reasons.items():
        assert reason in str(part_of(run).reason)
    assert part_of(empty).reason is not None
    monkeypatch.setattr("cosim.analysis.ideal_loop.network_fates", lambda *_: 1 / 0)
    assert part_of(record).reason == "ZeroDivisionError('division by zero')"
