"""FMUs as plants, FMI 2 and 3: against other integrators, and invalid FMUs."""

import fcntl
import json
import math
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import fmpy
import numpy as np
import pytest

import noack
from noack.extend import CallerError, PlantEquations, SystemFailedError
from noack.plants.linear import LinearSystem
from noack.plants.plant_settings import OdeSystem
from noack.settings.user_files import with_absolute_path
from noack_fmi.fmu_plant import FmuSettings, FmuSystem, _unpacked_fmus
from tests.helpers.approved import compare_lines, lines_of_error
from tests.noack.plants.motion import motion

Build = Callable[..., Path]
VERSIONS = pytest.mark.parametrize("version", [2, 3])


@pytest.fixture(autouse=True)
def own_folder_for_temporary_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    yield folder
    _unpacked_fmus.cache_clear()
    assert all(path.name in ("other", "noack-native-used") for path in folder.iterdir())


def settings(path: Path, **more: Any) -> FmuSettings:
    given = {"state_variables": ("x0", "x1"), "input_variables": ("u",)} | more
    loaded = with_absolute_path(FmuSettings(kind="fmu", file=str(path), **given), Path(), "scenario.toml")
    assert isinstance(loaded, FmuSettings)
    return loaded


INPUTS = [math.sin(0.01 * step) for step in range(200)]
X0 = np.array([1.0, -0.5])


@VERSIONS
def test_van_der_pol_agrees_with_another_integrator(version: int, tmp_path: Path, build: Build) -> None:
    def van_der_pol(t: float, z: np.ndarray, v: np.ndarray) -> tuple[float, float]:
        return float(z[1]), 2.0 * (1.0 - z[0] ** 2) * z[1] - z[0] + v[0]

    system = FmuSystem(settings(build(tmp_path, version), parameters={"mu": 2}, on_record=("energy",)), X0)
    np.testing.assert_allclose(
        motion(system, INPUTS),
        motion(OdeSystem(PlantEquations(van_der_pol), X0), INPUTS),
        atol=1e-9,
    )
    assert system.z == pytest.approx([(system.x[1] ** 2 + system.x[0] ** 2) / 2])


@VERSIONS
def test_x_and_u_are_deviations_from_the_operating_point(version: int, tmp_path: Path, build: Build) -> None:
    """At x0 = 2 the spring force is k x0 = 6; the operating input balances it."""
    loaded = settings(
        build(tmp_path, version), parameters={"k": 3.0, "linear": True},
        operating_state=(2.0, 0.0), operating_input=(6.0,),
    )  # fmt: skip
    still = FmuSystem(loaded, np.zeros(2))
    np.testing.assert_allclose(motion(still, [0.0] * 100), np.zeros((101, 2)), atol=1e-12)
    moved = FmuSystem(loaded, X0)
    linear = LinearSystem(np.array([[0, 1], [-3.0, -1]]), np.array([[0.0], [1]]), X0)
    np.testing.assert_allclose(motion(moved, INPUTS), motion(linear, INPUTS), atol=1e-11)


@VERSIONS
@pytest.mark.parametrize(("status", "name"), [(2, "discard"), (3, "error"), (4, "fatal")])
def test_a_failed_step_is_reported_once_with_the_reason(
    version: int, status: int, name: str, tmp_path: Path, build: Build
) -> None:
    parameters = {"fail_at_s": 0.02, "fail_status": status}
    system = FmuSystem(settings(build(tmp_path, version), parameters=parameters), X0)
    with pytest.raises(SystemFailedError) as failed:
        motion(system, [0.0] * 100)
    text = str(failed.value)
    assert name in text
    assert "the spring broke" in text
    assert "\n" not in text


@VERSIONS
def test_a_warning_is_not_a_failure_and_fmu_output_is_suppressed(
    version: int, tmp_path: Path, build: Build, capfd: pytest.CaptureFixture[str]
) -> None:
    system = FmuSystem(settings(build(tmp_path, version), parameters={"noisy": True}), X0)
    print("before")
    states = motion(system, INPUTS)
    print("after")
    assert np.isfinite(states).all()
    del system
    captured = capfd.readouterr()
    assert captured.out == "before\nafter\n"
    assert captured.err == ""


@VERSIONS
def test_settings_that_do_not_fit_the_fmu_are_refused_with_the_approved_line(
    version: int, tmp_path: Path, build: Build, own_folder_for_temporary_files: Path
) -> None:
    fmu = build(tmp_path, version)

    def refusal(more: str) -> list[str]:
        given = {
            key: tuple(value) if isinstance(value, list) else value for key, value in json.loads(more).items()
        }
        (line,) = lines_of_error(lambda: FmuSystem(settings(fmu, **given), X0))
        for old, new in (("Integer", "Int32"), ("Real", "Float64")):  # types of FMI 2
            line = line.replace(f"of type {old};", f"of type {new};")
        return [line]

    compare_lines(Path(__file__).with_name("fmu_mistakes.txt"), refusal)


@pytest.mark.parametrize(
    ("edit", "expected"),
    [
        (("CoSimulation modelId", "ModelExchange modelId"), "not for co-simulation"),
        (("{oscillator}", "{other}"), "cannot be started: Failed to instantiate"),
        (('modelIdentifier="oscillator"', 'modelIdentifier="other"'), "this machine needs"),
        (('fmiVersion="2.0"', 'fmiVersion="1.0"'), "is not an FMU of FMI 2 or 3, or is damaged"),
        (("</fmiModelDescription>", ""), "is not an FMU of FMI 2 or 3"),
    ],
)  # fmt: skip
def test_fmus_that_cannot_be_run_are_refused_in_one_line(
    edit: tuple[str, str], expected: str, tmp_path: Path, build: Build
) -> None:
    before = Path.cwd()
    (line,) = lines_of_error(lambda: FmuSystem(settings(build(tmp_path, 2, edit=edit)), X0))
    assert expected in line
    assert Path.cwd() == before


@VERSIONS
def test_an_fmu_changed_after_loading_is_not_run(version: int, tmp_path: Path, build: Build) -> None:
    path = build(tmp_path, version)
    loaded = settings(path)
    path.write_bytes(path.read_bytes() + b"\0")
    with pytest.raises(CallerError, match="has changed: its SHA-256 is"):
        FmuSystem(loaded, X0)
    path.unlink()
    with pytest.raises(CallerError, match="cannot be read: No such file"):
        FmuSystem(loaded, X0)


def test_an_fmu_is_unpacked_for_each_instance_at_a_time_and_removed_at_the_end(
    tmp_path: Path, build: Build, own_folder_for_temporary_files: Path
) -> None:
    fmu = build(tmp_path, 2)
    systems = [FmuSystem(settings(fmu), X0) for _ in range(2)]
    folders = {*own_folder_for_temporary_files.iterdir()}
    assert len(folders) == 2
    assert all((folder / "modelDescription.xml").is_file() for folder in folders)
    del systems
    system = FmuSystem(settings(fmu), X0)
    assert {*own_folder_for_temporary_files.iterdir()} == folders
    del system


def test_only_folders_left_by_killed_processes_are_removed(
    tmp_path: Path, build: Build, own_folder_for_temporary_files: Path
) -> None:
    left, used, other = (
        own_folder_for_temporary_files / name for name in ("noack-native-left", "noack-native-used", "other")
    )
    for folder in (left, used, other):
        (folder / "inside").mkdir(parents=True)
    lock = os.open(used, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        FmuSystem(settings(build(tmp_path, 2)), X0)
    finally:
        os.close(lock)
    assert not left.exists()
    assert used.exists()
    assert other.exists()


def test_an_fmu_that_requests_termination_has_failed(tmp_path: Path, build: Build) -> None:
    parameters = {"fail_at_s": 0.02, "fail_status": -1}
    system = FmuSystem(settings(build(tmp_path, 3), parameters=parameters), X0)
    with pytest.raises(SystemFailedError, match="requests the end of the simulation"):
        motion(system, [0.0] * 100)


def test_an_fmu_is_linearised_and_its_operating_point_goes_into_the_scenario(
    tmp_path: Path, build: Build, monkeypatch: pytest.MonkeyPatch
) -> None:
    """ẍ = u − k x + μ (1 − x²) ẋ: [[0, 1], [−1, 1]] at 0; at x = 1 it rests with u = 1."""
    monkeypatch.chdir(tmp_path)
    unpack = Mock(wraps=fmpy.extract)
    monkeypatch.setattr(fmpy, "extract", unpack)
    fmu = build(tmp_path, 2)
    at_rest = noack.linearise(str(fmu))
    assert unpack.call_count == 1  # for hundreds of instances
    np.testing.assert_allclose(at_rest.A, [[0, 1], [-1, 1]], atol=1e-4)
    np.testing.assert_allclose(at_rest.B, [[0], [1]], atol=1e-4)
    moved = noack.linearise(str(fmu), at=[1.0, 0.0], input=[1.0])
    np.testing.assert_allclose(moved.A, [[0, 1], [-1, 0]], atol=1e-4)
    made = noack.new(moved, "made.toml")
    assert made.scenario.plant.system.content()["operating_state"] == [1.0, 0.0]
    assert made.scenario.plant.system.content()["operating_input"] == [1.0]
    made.save("made.toml")
    assert noack.simulate(noack.load("made.toml", {"horizon_s": 0.5})).ok
