"""User classes as plants, and where compiled code is stored."""

import json
import sys
from pathlib import Path
from textwrap import dedent
from typing import Any

import numpy as np
import pytest

from netem.core.errors import CallerError
from noack.plants.plant_settings import SystemFailedError
from noack.plants.python_plant import PythonPlantSettings, PythonSystem
from noack.settings.user_files import with_absolute_path
from tests.helpers.approved import compare_lines
from tests.noack.plants.motion import H_NS, motion

X0 = np.array([0.3, 0.0])
PENDULUM = """
    import math
    from dataclasses import dataclass

    @dataclass
    class Pendulum:
        g: float = 9.81

        def derivative(self, t_s, z, u):
            return z[1], -self.g * math.sin(z[0]) + u[0]
"""
STEPPING = """
    import numpy as np

    class Stepping:
        def start(self, x0):
            self.x, self.z = x0, [0.0, 0.0, 0.0]

        def advance(self, u, t_s, dt_s):
            self.x[0] += dt_s * self.x[1]
            self.x[1] += dt_s * u[0]
            self.z = [t_s, dt_s, u[0]]
            u[0] = 1e9
"""


def settings(folder: Path, code: str, name: str, **more: Any) -> PythonPlantSettings:
    path = folder / "mine.py"
    path.write_text(dedent(code))
    loaded = with_absolute_path(
        PythonPlantSettings(kind="python", name=name, file=str(path), **more), Path(), "s.toml"
    )
    assert isinstance(loaded, PythonPlantSettings)
    return loaded


def made(folder: Path, code: str, name: str, **more: Any) -> PythonSystem:
    return PythonSystem(settings(folder, code, name, **more), X0, 1)


def test_a_plants_internal_state_is_mapped_and_recorded(tmp_path: Path) -> None:
    code = """
        import numpy as np

        class Sheared:
            def __init__(self, T):
                self.T = np.array(T)

            def state(self, x0):
                return np.append(np.linalg.solve(self.T, x0), 0.0)

            def output(self, z):
                return self.T @ z[:2]

            def derivative(self, t_s, z, u):
                return np.append(np.linalg.solve(self.T, [(self.T @ z[:2])[1], u[0]]), 1.0)
    """
    system = made(
        tmp_path, code, "Sheared",
        parameters={"T": ((2.0, 1.0), (0.0, 3.0))}, on_record=("a", "b", "clock"),
    )  # fmt: skip
    assert system.x.tolist() == pytest.approx(X0.tolist())
    motion(system, [2.0] * 500)
    assert system.x.tolist() == pytest.approx([0.3 + 1.0, 2.0])
    assert system.z[2] == pytest.approx(1.0)


def test_a_class_may_define_its_own_step_and_cannot_change_the_loops_arrays(tmp_path: Path) -> None:
    system = made(tmp_path, STEPPING, "Stepping", on_record=("t", "dt", "u"))
    u = np.array([2.0])
    system.advance(u, 5 * H_NS, H_NS)
    first = system.x
    kept = first.copy()
    system.advance(u, 6 * H_NS, H_NS)
    assert u.tolist() == [2.0]
    assert first.tolist() == kept.tolist()
    assert system.z.tolist() == [6 * H_NS * 1e-9, H_NS * 1e-9, 2.0]
    assert system.x[1] == pytest.approx(8e-3)


def test_a_plant_is_found_by_entry_point_and_by_module(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "installed_plants.py").write_text(dedent(PENDULUM))
    folder = tmp_path / "installed_plants-1.2.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Name: installed-plants\nVersion: 1.2\n")
    (folder / "entry_points.txt").write_text("[noack.plants]\nswing = installed_plants:Pendulum\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "installed_plants", raising=False)
    by_entry = PythonSystem(PythonPlantSettings(kind="python", name="swing"), X0, 1)
    assert by_entry.about == "class installed_plants:Pendulum, installed-plants 1.2"
    by_module = PythonSystem(PythonPlantSettings(kind="python", name="installed_plants:Pendulum"), X0, 1)
    for system in (by_entry, by_module):
        system.advance(np.zeros(1), 0, H_NS)
    assert by_entry.x.tobytes() == by_module.x.tobytes()
    with pytest.raises(CallerError, match=r"no installed package has .*there are: .*swing"):
        PythonSystem(PythonPlantSettings(kind="python", name="swung"), X0, 1)


def test_a_mistake_in_a_class_gives_the_approved_line(tmp_path: Path) -> None:
    """It is refused before the run, or a step fails after ten good ones."""

    def mistake(line: str) -> list[str]:
        try:
            system = made(tmp_path, json.loads(line), "P")
        except CallerError as error:
            return str(error).splitlines()
        assert np.isfinite(motion(system, [0.0] * 10)).all()
        with pytest.raises(SystemFailedError) as failed:
            motion(system, [0.0] * 20)
        return [f"during the run: {failed.value}"]

    with np.errstate(all="raise"):
        compare_lines(Path(__file__).with_name("class_mistakes.txt"), mistake)


@pytest.mark.parametrize(
    ("slope", "expected"),
    [
        ("[-1e9 * (z[0] - math.cos(t_s)), 0.0]", "too stiff for an explicit integrator"),
        ("[1e9 * math.copysign(1.0, math.sin(1e9 * z[0]) - 0.1), 0.0]", "integrated at 2."),
    ],
)
def test_a_failed_integration_is_not_reported_as_divergence(
    slope: str, expected: str, tmp_path: Path
) -> None:
    code = f"""
        import math

        class P:
            def derivative(self, t_s, z, u):
                return {slope}
    """
    system = made(tmp_path, code, "P")
    with pytest.raises(SystemFailedError, match=expected):
        motion(system, [0.0] * 20)
    assert np.isfinite(system.x).all()
