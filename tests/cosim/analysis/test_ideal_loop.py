"""The difference to the ideal loop, against the exact run of the scenario, and where there is none."""

import json
from pathlib import Path

import numpy as np
import pytest

from cosim.analysis.ideal_loop import ideal_loop_part
from cosim.analysis.summary.loop_summary import summarise_loop
from cosim.analysis.summary.summary_model import IdealLoopPart, NoIdealLoopPart
from cosim.record.run_record import RunRecord
from cosim.simulation.continuous import run_continuous
from cosim.simulation.virtual_time import simulate
from noack.protocol.record_tables import PLANT_STEP
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load

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


def test_the_ideal_loop_loses_what_the_run_lost() -> None:
    """The run's network loses nothing, whatever the emulator would have lost."""
    settings = ["horizon_s=4", "plant.rate_hz=100", "controller.rate_hz=100"]
    record = simulate(resolve(load(LANE, settings)), lambda data, now_ns: 0)
    lossless = run_continuous(resolve(load(LANE, [*settings, "network.loss.probability=0"])))
    assert compared(record).events == len(lossless.event_s) != len(run_continuous(record.scenario).event_s)
