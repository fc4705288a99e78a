"""Equations are finite and defined on the whole region, or they have no certificate."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from cosim.analysis.witnesses import find_statement
from cosim.cli.application import app
from netem.core.errors import ExitStatus
from noack.plants.systems.traced_equations import NotEnclosedError, trace
from noack.proof.elaborate.loop import Region
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load
from noack_equations import RejectedError, enclose
from tests.checker.traced_plants import Plant, unexplained

CASES = Path(__file__).parent.parent / "cases"
WIDTHS = np.array([0.8, 0.6, 1.0])
Field = Callable[[Any, Any], Any]
UNDEFINED: dict[str, tuple[Field, str]] = {
    "0 log": (lambda x, u: [0.0 * np.log(1 + 2 * x[0]), x[1]], "log of a number that may be 0"),
    "(x - x) log": (lambda x, u: [(x[0] - x[0]) * np.log(1 + 2 * x[0]), x[1]], "log of a number"),
    "0 / (x - c)": (lambda x, u: [0.0 / (x[0] - 0.3), x[1]], "division by"),
    "x / x": (lambda x, u: [x[0] / x[0], x[1]], "division by"),
    "0 root": (lambda x, u: [0 * np.sqrt(0.2 - x[0]), x[1]], "root of a number that may be negative"),
    "root": (lambda x, u: [np.sqrt((x[0] - 0.5) ** 2 - 1e-7), x[1]], "may be negative"),
    "half a power": (lambda x, u: [((x[0] - 0.5) ** 2 - 1e-7) ** 0.5, x[1]], "may be negative"),
    "root of a size": (lambda x, u: [np.sqrt(abs(x[0])), x[1]], "its slope is infinite"),
    "0 tan": (lambda x, u: [0 * np.tan(4 * x[0]), x[1]], "tan of an angle"),
    "0 power": (lambda x, u: [0 * (x[0] + 0.2) ** 1.5, x[1]], "power of"),
    "an overflow": (lambda x, u: [0 * np.exp(2000 * x[0]), x[1]], "exp may be too large"),
    "a sign": (lambda x, u: [np.sign(np.log(x[0] + 0.7)), x[1]], "log of a number"),
    "a limit": (lambda x, u: [np.clip(np.log(x[0] + 0.7), -1, 1), x[1]], "log of a number"),
    "tanh": (lambda x, u: [np.tanh(1 / (x[0] + 0.7)), x[1]], "division by"),
    "not used": (lambda x, u: [(np.log(x[0]), u[0])[1], x[1]], "log of a number"),
    "arcsin": (lambda x, u: [np.arcsin(2 * x[0]), x[1]], "np.arcsin has no enclosure"),
    "arctan2": (lambda x, u: [np.arctan2(x[0], x[1]), x[1]], "np.arctan2 has no enclosure"),
}


@pytest.mark.parametrize("name", UNDEFINED)
def test_equations_that_are_not_finite_have_no_enclosure(name: str) -> None:
    field, reason = UNDEFINED[name]
    with pytest.raises(NotEnclosedError, match=reason):
        trace(Plant(field), 2, 1, WIDTHS)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "steps",
    [
        [["state", 0], ["log", 0], ["number", 0.0], ["times", 1, 2]],
        [["state", 0], ["power", 0, -1], ["number", 0.0], ["times", 1, 2]],
        [["state", 0], ["root", 0], ["number", 0.0], ["times", 1, 2]],
        [["state", 0], ["number", 800.0], ["times", 0, 1], ["exp", 2], ["number", 0.0], ["times", 3, 4]],
        [["time"], ["log", 0], ["number", 0.0], ["times", 1, 2]],
        [["number", -1.0], ["log", 0], ["state", 0]],
    ],
)
def test_no_step_of_a_document_is_undefined(steps: list[Any]) -> None:
    from flint import arb

    with pytest.raises(RejectedError, match="not finite on the whole region"):
        enclose({"steps": steps, "rates": [len(steps) - 1]}, Region((arb(1),), (arb(1),)))


NORMS: dict[str, Field] = {
    "hypot": lambda x, u: [u[0] - x[0] * np.hypot(x[0], x[1]), -x[1] * np.hypot(x[0], x[1])],
    "root": lambda x, u: [u[0] - x[0] * np.sqrt(x[0] ** 2 + x[1] ** 2), -x[1] * (x @ x) ** 0.5],
    "norm": lambda x, u: [u[0] - x[0] * np.linalg.norm(x), -x[1] * np.linalg.norm(x)],
    "a weighted one": lambda x, u: [u[0] - np.sqrt(2 * (x[0] ** 2 + 3 * x[1] ** 2) / 5), x[1]],
    "of a square": lambda x, u: [u[0] - x[0] * np.sqrt(x[0] ** 2), x[1]],
    "away from 0": lambda x, u: [u[0] - np.hypot(x[0] + 0.5, x[1] - 0.1) + np.hypot(0.5, 0.1), x[1]],
    "rounded off": lambda x, u: [u[0] - x[1] * np.sqrt(x[0] ** 2 + x[1] ** 2 + 1e-6), x[1]],
}  # fmt: skip


@pytest.mark.parametrize("name", NORMS)
def test_roots_of_sums_of_squares_are_enclosed(name: str) -> None:
    field, rng = NORMS[name], np.random.default_rng(1)
    plants = trace(Plant(field), 2, 1, WIDTHS).plants  # type: ignore[arg-type]
    z = rng.uniform(-1, 1, (100, 3)) * WIDTHS
    z[::2] *= rng.choice([1.0, 1e-3], (50, 3))
    assert unexplained(plants, field, z).max() <= 1e-6


def test_drag_in_a_plane_only_brakes() -> None:
    plants = trace(Plant(NORMS["hypot"]), 2, 1, WIDTHS).plants  # type: ignore[arg-type]
    for i in range(2):  # the slope of −v_i ‖v‖ is from −‖v‖, at most 1, to 0
        assert float(plants.A[i, i]) == pytest.approx(-0.5)
        assert float(plants.half_A[i, i]) == pytest.approx(0.5)
    assert float(plants.half_A[0, 1]) == 0


DRAG = """import math
class Drag:
    def derivative(self, t_s, z, u):
        speed = math.hypot(z[0], z[1])
        return u[0] - 0.4 * z[0] * speed, u[1] - 0.4 * z[1] * speed
"""


def test_a_plant_with_drag_in_a_plane_has_a_proof(tmp_path: Path) -> None:
    (tmp_path / "drag.py").write_text(DRAG)
    rows = {
        "model.A": [[0.0, 0.0], [0.0, 0.0]],
        "model.B": [[1.0, 0.0], [0.0, 1.0]],
        "model.gain": [[-2.0, 0.0], [0.0, -2.0]],
        "plant.initial_state": [0.3, -0.2],
    }
    settings = [f"{key}={json.dumps(value)}" for key, value in rows.items()]
    settings.append(f'plant.system={{kind="python", file="{tmp_path}/drag.py", name="Drag"}}')
    statement = find_statement(resolve(load(CASES / "eq_Root2.toml", settings)), "region", "ideal")
    assert statement.document is not None, statement.reason


@pytest.mark.parametrize(
    ("case", "name"),
    [("ZeroLog", "ZeroLog"), ("ZeroLog", "ZeroLog2"), ("Root2", "ZeroInf"), ("Root2", "Root"),
     ("Root2", "Root2"), ("Root2", "Root3")],
)  # fmt: skip
def test_a_region_does_not_reach_where_the_equations_are_undefined(case: str, name: str) -> None:
    resolved = resolve(load(CASES / f"eq_{case}.toml", [f"plant.system.name={name}"]))
    statement = find_statement(resolved, "region", "ideal")
    assert statement.document is None
    assert statement.reason.count("not finite on the whole region") == 1


def test_certify_names_what_is_undefined() -> None:
    result = CliRunner().invoke(app, ["certify", str(CASES / "eq_ZeroLog.toml"), "--no-search"])
    assert result.exit_code == ExitStatus.FAILED
    text = " ".join(result.stdout.split())
    assert (
        "its equations are not finite on the whole region: log of a number that may be 0 or negative" in text
    )
    assert "proved" not in text
