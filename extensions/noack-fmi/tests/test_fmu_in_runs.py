"""Runs with an FMU: moved, stored, replayed, failed; the README's example."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import noack
from noack.extend import CallerError
from tests.helpers.command_line import invoke
from tests.helpers.pages import blocks

Build = Callable[..., Path]
README = Path(__file__).parents[1] / "README.md"
(EXAMPLE,) = blocks(README, "toml")
CLASS = """
class VanDerPol:
    def derivative(self, t_s, z, u):
        return z[1], (1 - z[0] ** 2) * z[1] - z[0] + u[0]
"""


@pytest.fixture
def scenario(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, build: Build) -> Path:
    monkeypatch.chdir(tmp_path)
    build(tmp_path, 2).rename("oscillator.fmu")
    path = tmp_path / "oscillator.toml"
    path.write_text(EXAMPLE)
    return path


@pytest.mark.parametrize("version", [2, 3])
def test_an_fmu_moves_like_a_python_class_with_the_same_equations(
    version: int, scenario: Path, build: Build
) -> None:
    build(Path(), version).rename("oscillator.fmu")
    of_fmu = noack.simulate(scenario)
    Path("mine.py").write_text(CLASS)
    system = {"kind": "python", "file": "mine.py", "name": "VanDerPol"}
    of_class = noack.simulate(noack.load(scenario, {"plant.system": system}))
    (x_1, x_2), theirs = (
        [np.array(run.table("plant_step")[name]) for name in ("x_1", "x_2")] for run in (of_fmu, of_class)
    )
    np.testing.assert_allclose((x_1, x_2), theirs, atol=1e-9)
    assert np.hypot(x_1[-1], x_2[-1]) < 0.2  # the loop is closed
    energy = np.array(of_fmu.table("plant_step")["z_1"])
    np.testing.assert_allclose(energy, (x_1**2 + x_2**2) / 2, rtol=1e-12)
    assert of_fmu.replay().bit_exact


def test_a_run_stores_its_fmu_and_is_replayed_without_the_original(scenario: Path) -> None:
    run_dir = noack.simulate(noack.load(scenario, {"horizon_s": 1.0}), runs="runs").directory
    scenario.with_suffix(".fmu").unlink()
    elsewhere = Path("elsewhere")
    shutil.move(run_dir, elsewhere)
    assert noack.open_run(elsewhere).replay().bit_exact
    (kept,) = (elsewhere / "plant").iterdir()
    kept.write_bytes(kept.read_bytes() + b"\n")
    run = noack.open_run(elsewhere)  # the record is still readable
    with pytest.raises(CallerError, match="has changed: its SHA-256 is") as refused:
        run.replay()
    assert "\n" not in str(refused.value)


def test_a_failed_fmu_stops_moving_and_the_run_is_recorded(scenario: Path) -> None:
    failing = {"plant.system.parameters": {"fail_at_s": 0.5, "fail_status": 3}, "horizon_s": 1.0}
    run = noack.simulate(noack.load(scenario, failing))
    assert not run.ok
    x = np.array(run.table("plant_step")["x_1"])
    assert len(x) == 501
    assert np.isfinite(x[:251]).all()
    assert np.isnan(x[251:]).all()
    assert run.replay().bit_exact


@pytest.mark.parametrize(
    ("setting", "expected"),
    [
        ('plant.system.file="gone.fmu"', 'plant.system.file = "gone.fmu": cannot be read: No such'),
        ('plant.system.state_variables=["x1"]', 'plant.system.state_variables = ["x1"]: expected 2 entries'),
    ],
)
def test_settings_that_are_wrong_are_refused(scenario: Path, setting: str, expected: str) -> None:
    done = invoke("check", scenario, "--set", setting)
    assert done.exit_code == 2
    assert expected in done.stderr


@pytest.mark.usefixtures("scenario")
def test_linearise_takes_the_file() -> None:
    linear = json.loads(invoke("linearise", "oscillator.fmu", "--json").stdout)
    np.testing.assert_allclose(linear["A"], [[0, 1], [-1, 1]], atol=1e-4)
    done = invoke("linearise", "gone.fmu")
    assert 'plant.system.file = "gone.fmu": cannot be read: No such file' in done.stderr


@pytest.mark.live
def test_a_live_run_takes_the_scenario(scenario: Path) -> None:
    done = invoke("run", scenario, "--set", "horizon_s=1", "--no-report", "--set", "ports={}")
    assert done.exit_code == 0, done.output
