"""Loops of every day as real processes: an unknown load, an integral, a trajectory, and dry friction."""

import json
from pathlib import Path

import numpy as np
import pytest

import noack
from noack.core.linear_systems import Vector
from tests.helpers.command_line import invoke
from tests.helpers.live_runs import BARE, settings

pytestmark = pytest.mark.live

TRACK = ["t_s,angle,speed,voltage"]
for t_s in np.arange(0.0, 2.005, 0.01):  # 0.2 rad to and fro: ÿ = 4 u − 2 ẏ
    y, rate, slope = 0.1 * (1 - np.cos(3 * t_s)), 0.3 * np.sin(3 * t_s), 0.9 * np.cos(3 * t_s)
    TRACK.append(",".join(str(float(value)) for value in (t_s, y, rate, (slope + 2 * rate) / 4)))

TRACKING = """
name = "track"
horizon_s = 2.0

[model]
A = [[0.0, 1.0], [0.0, -2.0]]
B = [[0.0], [4.0]]
gain = [[-3.0, -1.25]]
state_names = ["angle", "speed"]
input_names = ["voltage"]

[plant]
initial_state = [0.0, 0.0]

[[controller.reference]]
kind = "file"
file = "track.csv"
tolerance = 1e-3

[[outputs]]
name = "angle"
unit = "rad"
allowed = 0.15

[trigger]
beta = 0.02
alpha_per_s = 0.5
floor = 0.005

[network]
mansd = 3
loss = { model = "bernoulli", probability = 0.5 }
"""


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def run_live(scenario: str, *more: str) -> None:
    """Run a scenario as processes: its record replays bit for bit, and refutes no claim."""
    result = invoke(
        "run", scenario, "--json", "--runs", "runs", *BARE, *settings(speed=2.0, horizon_s=2.0), *more
    )
    assert result.exit_code == 0, result.stderr
    (loop,) = json.loads(result.stdout)["loops"]
    assert loop["replay"]["bit_exact"], loop["replay"]  # a machine that stalls may lose samples
    assert "violated" not in {claim["verdict"] for claim in loop["claims"]}


def in_virtual_time(scenario: str, table: str, column: str) -> tuple[Vector, Vector]:
    """Return times and a column of the same loop in virtual time, in which no machine is late."""
    run = noack.simulate(noack.load(scenario, {"certificate.prove": False}))
    rows = run.table(table).to_pydict()
    return np.array(rows["t_s"]), np.array(rows[column])


def test_the_sensor_of_a_loop_estimates_an_unknown_load() -> None:
    run_live("dc_motor_load")
    _, load = in_virtual_time("dc_motor_load", "sensor_measurement", "x_3")
    assert load[-1] == pytest.approx(0.2, rel=1e-3)


def test_a_loop_follows_a_trajectory_from_a_file() -> None:
    Path("track.csv").write_text("\n".join(TRACK))
    Path("track.toml").write_text(TRACKING)
    run_live("track.toml")
    t_s, angle = in_virtual_time("track.toml", "plant_step", "angle")
    assert np.abs(angle - 0.1 * (1 - np.cos(3 * t_s))).max() < 0.03


def test_a_loop_with_dry_friction_runs_live() -> None:
    run_live("friction_servo")


def test_a_loop_with_an_integral_and_a_reference_runs_live() -> None:
    run_live(
        "servo_reference", "--set", "model.gain=[[-11.75, -2.5, 15.0]]", "--set", 'model.integral="angle"'
    )
