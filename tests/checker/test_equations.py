"""The equations of plants on a region: their enclosure, and witnesses of what stays in it."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flint import arb

from cosim.analysis.loop_files import loop_files
from cosim.analysis.witnesses import find_statement
from noack.plants.systems.traced_equations import NotEnclosedError, trace
from noack.proof.elaborate.loop import Region
from noack.proof.equations_claim import equations_text
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load
from noack.theory.witnesses.coordinates import floats
from noack_equations import RejectedError as RejectedEquationsError
from noack_equations import enclose, prove_equations
from noack_kernel import RejectedError as RejectedByKernelError
from noack_kernel import prove as prove_by_kernel
from tests.checker.proofs import proved
from tests.checker.traced_plants import Field, Plant, unexplained
from tests.oracles.attacked_regions import SCENARIOS, largest_shares, largest_sizes, pendulum

FIELDS: dict[str, Field] = {
    "Coulomb friction": lambda x, u: [x[1], u[0] - 2 * x[0] - 0.3 * np.sign(x[1]) + 0.1 * x[1] ** 3],
    "friction with a bend": lambda x, u: [x[1], u[0] * np.cos(x[0]) - 0.4 * np.tanh(20 * x[1])],
    "a saturated input": lambda x, u: [np.sin(x[1]), 3 * np.clip(u[0] - x[0], -0.5, 0.8) - x[1] * abs(x[1])],
    "a dead zone": lambda x, u: [x[1], (v := u[0] - x[1]) - np.clip(v, -0.1, 0.1) + np.arctan(3 * x[0])],
    "an outlet": lambda x, u: [np.sqrt(np.maximum(x[0] + 1, 0)) - 1 - x[1], u[0] / (2 + x[0]) - x[1]],
    "a sign of two states": lambda x, u: [x[1], np.exp(-x[0]) * np.sign(x[0] + x[1]) + u[0]],
}


@pytest.mark.parametrize("name", FIELDS)
def test_equations_lie_within_the_plants_that_enclose_them(name: str) -> None:
    field, rng = FIELDS[name], np.random.default_rng(0)
    for widths in (np.array([0.8, 0.6, 1.5]), np.array([0.3, 0.05, 0.2])):
        plants = trace(Plant(field), 2, 1, widths).plants  # type: ignore[arg-type]
        z = rng.uniform(-1, 1, (30, 3)) * widths
        z[::2] = np.sign(z[::2]) * widths * rng.choice([1.0, 1e-3], (15, 3))
        assert unexplained(plants, field, z).max() <= 1e-6
        smaller = trace(Plant(field), 2, 1, widths / 4).plants  # type: ignore[arg-type]
        if name not in ("Coulomb friction",):
            assert unexplained(smaller, field, 3 * z).max() > 0


def test_friction_is_a_signal_that_takes_energy() -> None:
    plants = trace(Plant(FIELDS["Coulomb friction"]), 2, 1, np.array([np.inf, 1.0, np.inf])).plants  # type: ignore[arg-type]
    assert floats(plants.pushes).tolist() == [[0.0], [-0.3]]
    [(row, least)] = plants.along
    assert floats(row).tolist() == [[0.0, 1.0, 0.0]]
    assert least == 0


def test_a_small_signal_is_no_missing_one() -> None:
    """clip(x₁ sign(x₂)) has a slope of at most 1e-13 along the sign, which is not 0."""
    steps = [["state", 0], ["state", 1], ["sign", 1], ["times", 2, 0], ["clip", 3, -1e-14, 1e-14]]
    plants = enclose({"steps": steps, "rates": [4, 1]}, Region((arb(1e-13), arb(1)), (arb(1),)))
    assert all(least == 0 for _, least in plants.along)


def test_a_slope_that_varies_little_is_no_constant() -> None:
    """Exponentials of A are about a constant A: 1 − cos x is 5e-15 at most, and rounding is 1e-38."""
    steps = [["state", 0], ["cos", 0], ["times", 0, 1], ["number", 0.1], ["times", 0, 3], ["add", 2, 4]]
    plants = enclose({"steps": steps, "rates": [5]}, Region((arb(1e-7),), (arb(1),)))
    assert 1e-15 < float(plants.half_A[0, 0]) < 1e-13
    exact = enclose({"steps": steps, "rates": [4]}, Region((arb(1e-7),), (arb(1),)))
    assert exact.half_A[0, 0] == 0


def test_a_signal_of_which_the_size_is_around_0_is_kept() -> None:
    steps = [["state", 0], ["state", 1], ["number", 1e9], ["times", 1, 2], ["sign", 0], ["cos", 1],
             ["number", -1.0], ["add", 5, 6], ["times", 4, 7], ["add", 3, 8]]  # fmt: skip
    plants = enclose({"steps": steps, "rates": [9, 1]}, Region((arb(1), arb(1e-3)), (arb(1),)))
    # 1e9 x₂ + (cos x₂ − 1) sign x₁
    assert plants.pushes.ncols() > 0
    size = sum((plants.pushes[0, k].abs_upper() for k in range(plants.pushes.ncols())), arb(0))
    assert size >= 4e-7


BUFFER = np.zeros(1)
OPTIONS: dict[str, Field] = {
    "out": lambda x, u: [np.sin(x[1], out=BUFFER)[()] and BUFFER[0], u[0]],
    "clip into an array": lambda x, u: [x[1], np.clip(u[0], -1.0, 1.0, out=BUFFER)],
    "a limit of infinity": lambda x, u: [x[1], np.minimum(u[0], -np.inf)],
    "a limit that is no number": lambda x, u: [x[1], np.clip(u[0], np.nan, 1.0)],
}


@pytest.mark.parametrize("name", OPTIONS)
def test_what_is_not_noted_has_no_enclosure(name: str) -> None:
    with pytest.raises(NotEnclosedError):
        trace(Plant(OPTIONS[name]), 2, 1, np.array([0.8, 0.6, 1.5]))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("steps", "rates", "reason"),
    [
        ([], [0], "not from 1 to"),
        ([["state", 1]], [0], "no such state"),
        ([["state", 0], ["add", 0, 2]], [0], "refers to none before it"),
        ([["state", 0], ["gamma", 0]], [0], "is no step of such a shape"),
        ([["state", 0], ["sin", 0, 1]], [0], "is no step of such a shape"),
        ([["state", 0], ["power", 0, 1e6]], [1], "exponent"),
        ([["state", 0], ["power", 0, "2"]], [1], "not a number"),
        ([["state", 0], ["power", 0, -1]], [1], "not finite on the whole region"),
        ([["state", 0], ["log", 0]], [1], "not finite on the whole region"),
        ([["state", 0], ["tan", 0]], [1], "not finite on the whole region"),
        ([["state", 0], ["root", 0]], [1], "not finite on the whole region"),
        ([["state", 0], ["positive", 0]], [0], "distinguish cases"),
        ([["number", float("inf")]], [0], "not finite"),
        ([["state", 0]], [True], "refers to none"),
        ([["state", 0]], [], "not one rate for each state"),
    ],
)
def test_wrong_equations_are_rejected(steps: Any, rates: Any, reason: str) -> None:
    with pytest.raises(RejectedEquationsError, match=reason):
        enclose({"steps": steps, "rates": rates}, Region((arb(2),), (arb(1),)))


SATURATED = """import numpy as np
class Saturated:
    def derivative(self, t_s, z, u):
        return z[1], 9.81 * np.sin(z[0]) - 0.1 * z[1] + np.clip(u[0], -{limit}, {limit})
"""


@pytest.mark.parametrize(("limit", "is_proven"), [(9.0, True), (5.0, False)])
def test_a_saturated_input_is_proven_to_stay_inside_its_limits(
    tmp_path: Path, limit: float, is_proven: bool
) -> None:
    (tmp_path / "own.py").write_text(SATURATED.format(limit=limit))
    system = f'plant.system={{kind="python", file="{tmp_path}/own.py", name="Saturated"}}'
    resolved = resolve(load(SCENARIOS / "sine_pendulum.toml", [system]))
    statement = find_statement(resolved, "region", "ideal")
    if not is_proven:  # the first input is 7.5 N m
        assert "|angle| ≤" in statement.reason
        assert "|torque| ≤" in statement.reason
        return
    assert statement.document is not None, statement.reason
    assert statement.document["region"]["u"][0] < limit  # type: ignore[index]
    files = loop_files(resolved, statement)
    assert files.verify()
    assert prove_equations(files.document, equations_text(statement.document)).limits
    proof = json.loads(files.proof)
    proof["bounds"] = [entry for entry in proof["bounds"] if entry["output"] != "input 0"]
    with pytest.raises(RejectedByKernelError, match="while input 0: no proven bound is below"):
        prove_by_kernel(files.document, json.dumps(proof))


def test_no_attack_exceeds_what_is_proven_on_a_region() -> None:
    statement = proved("sine_pendulum_schedule")
    step_s = float(arb(statement.loop.times.sampling))
    sizes = largest_sizes(statement.loop, pendulum, step_s=step_s, steps=600, runs=100)
    worst = largest_shares(sizes, statement.bounds, step_s)
    assert "x[0]" in worst  # of which the region has a limit
    assert max(worst.values()) < 1, worst
    assert min(worst[signal] for signal in ("x", "e_s", "e_c")) > 0.1
