"""Runs with a user's plant, a class: stored, replayed, failed, refused."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from cosim.analysis.replay import replay
from cosim.live.finalize import finalize
from cosim.record.run_record import load_record
from cosim.simulation.virtual_time import simulate_run
from netem.core.errors import CallerError
from noack.protocol.record_tables import PLANT_STEP
from noack.scenario.scenario_file import load

PLANT_SCENARIO = """
name = "own"
horizon_s = 1.0
[model]
A = [[0.0, 1.0], [-1.0, 1.0]]
B = [[0.0], [1.0]]
gain = [[-3.0, -5.0]]
[plant]
system = SYSTEM
initial_state = [1.0, 0.0]
[trigger]
beta = 0.05
alpha_per_s = 0.5
floor = 0.002
[network]
mansd = 3
loss = { model = "bernoulli", probability = 0.5 }
"""
PYTHON = '{ kind = "python", file = "models/mine.py", name = "VanDerPol", parameters = PARAMETERS }'
PLANT_CODE = """
class VanDerPol:
    def __init__(self, mu=1.0, broken_at_s=1e9):
        self.mu, self.broken_at_s = mu, broken_at_s

    def derivative(self, t_s, z, u):
        if t_s > self.broken_at_s:
            raise RuntimeError("no more grease")
        return z[1], self.mu * (1 - z[0] ** 2) * z[1] - z[0] + u[0]
"""


def prepared(folder: Path, system: str, parameters: str) -> Path:
    path = folder / "own.toml"
    path.write_text(PLANT_SCENARIO.replace("SYSTEM", system).replace("PARAMETERS", parameters))
    (folder / "models").mkdir()
    (folder / "models" / "mine.py").write_text(PLANT_CODE)
    return path


def simulated(path: Path, horizon_s: float = 1.0) -> Path:
    return simulate_run(load(path, [f"horizon_s={horizon_s}"]), path.parent / "runs").run_dir


def test_a_run_stores_its_plant_and_is_replayed_without_the_original(tmp_path: Path) -> None:
    path = prepared(tmp_path, PYTHON, "{ mu = 2.0 }")
    run_dir = simulated(path)
    shutil.rmtree(tmp_path / "models")
    elsewhere = tmp_path / "elsewhere"
    run_dir.rename(elsewhere)
    assert replay(load_record(elsewhere)).bit_exact
    (kept,) = (elsewhere / "plant").iterdir()
    kept.write_bytes(kept.read_bytes() + b"\n")
    record = load_record(elsewhere)  # the record is still readable
    with pytest.raises(CallerError, match="has changed: its SHA-256 is") as refused:
        replay(record)
    assert "\n" not in str(refused.value)


def test_a_failed_plant_stops_moving_and_the_run_is_recorded(tmp_path: Path) -> None:
    path = prepared(tmp_path, PYTHON, "{ broken_at_s = 0.5 }")
    expected = (
        'the plant failed at 0.502 s: plant.system.name = "VanDerPol": RuntimeError: no more '
        "grease (mine.py, line 8)"
    )
    ending = simulate_run(load(path), tmp_path / "runs")
    outcome = finalize(ending, report=False, view=False)
    assert outcome.status == 1
    assert outcome.reason == expected
    record = load_record(ending.run_dir)
    x = record[PLANT_STEP]["x"]
    assert len(x) == 501
    assert np.isfinite(x[:251]).all()
    assert np.isnan(x[251:]).all()
    (notice,) = [notice for notice in record.notices if notice["level"] == "failed"]
    assert notice["t_ns"] == 502_000_000
    assert replay(record).bit_exact
    (loop,) = outcome.summary.loops
    assert loop.rejected_datagrams["sensor"]["not_finite"] > 0
    assert loop.unintended_losses == 0  # what is rejected has arrived
