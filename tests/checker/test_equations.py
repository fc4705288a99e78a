"""The equations of plants on a region: their enclosure, and witnesses of what stays in it."""

import copy
import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flint import arb
from noack_check.__main__ import check_file

from cosim.analysis.witnesses import find_statement, resolved_content
from noack.plants.systems.traced_equations import NotEnclosedError, trace
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load
from noack.theory.witnesses.coordinates import floats
from noack_check.check import RejectedError
from noack_check.equation_text import equation_lines
from noack_check.keys import RefusedError
from noack_check.loop import Region
from noack_equations import RejectedError as RejectedEquationsError
from noack_equations import enclose
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


@pytest.fixture(scope="module")
def witness() -> dict[str, Any]:
    """Return the file of a witness: a pendulum on a region, ideal conditions."""
    content = resolved_content(resolve(load(SCENARIOS / "sine_pendulum.toml")))
    return {"scenario": content, "statements": [proved("sine_pendulum").document]}


def test_a_region_is_proven_with_the_equations_in_words(witness: dict[str, Any]) -> None:
    lines = [*check_file(witness, None, text_of(witness))]
    assert any("|x_1| ≤ " in line for line in lines)
    digest = hashlib.sha256(text_of(witness).encode()).hexdigest()
    assert lines[0].startswith(f'PROVED "sine_pendulum", the plant with the equations {digest[:12]}, ideal')
    assert lines[-1].startswith(
        f"       and the plant has the equations with the SHA-256 {digest}: dx_1/dt = "
    )
    assert lines[-1].endswith("dx_2/dt = (((sin(x_1) · 9.81) + (−(x_2 · 0.1))) + u_1)")


def text_of(witness: dict[str, Any]) -> str:
    """Return the equations of a witness, as ``noack certify --equations`` writes them."""
    return "".join(f"{line}\n" for line in equation_lines(witness["statements"][0]["equations"]))


def test_equations_are_read_line_by_line(witness: dict[str, Any]) -> None:
    assert text_of(witness).splitlines() == [
        "s_5 = sin(x_1)", "s_7 = s_5 · 9.81", "s_9 = x_2 · 0.1", "s_10 = −s_9", "s_11 = s_7 + s_10",
        "s_12 = s_11 + u_1", "dx_1/dt = x_2", "dx_2/dt = s_12",
    ]  # fmt: skip


def test_a_statement_about_equations_demands_their_file(witness: dict[str, Any]) -> None:
    with pytest.raises(RejectedError, match=r"equations with the digest [0-9a-f]{64}: give the file"):
        list(check_file(witness, None))
    other = text_of(witness).replace("9.81", "9.8")
    with pytest.raises(RejectedError, match="about other equations than --equations: digest"):
        list(check_file(witness, None, other))
    several = f"{other}\n{text_of(witness)}"
    assert any(line.startswith("PROVED") for line in check_file(witness, None, several))
    weaker = copy.deepcopy(witness)
    steps = weaker["statements"][0]["equations"]["steps"]
    [gravity] = [step for step in steps if step[:1] == ["number"] and step[1] > 9]
    gravity[1] *= 0.5
    with pytest.raises(RejectedError, match="about other equations"):
        list(check_file(weaker, None, text_of(witness)))


def change(document: Any, place: tuple[Any, ...], value: Any) -> None:
    """Set a value in a document."""
    for key in place[:-1]:
        document = document[key]
    document[place[-1]] = value(document[place[-1]]) if callable(value) else value


@pytest.mark.parametrize(
    ("place", "value", "reason"),
    [
        (("region", "x", 0), lambda r: 0.5 * r, r"region: x\[0\] may leave it"),
        (("region", "x", 0), lambda r: 1.6 * r, "flow/"),  # the remainder would be too small
        (("region", "x", 0), None, "flow/"),
        (("region", "u", 0), 10.0, r"region: u\[0\] has no bound"),
        (("region", "x", 1), 10.0, r"region: x\[1\] has no bound"),
        (("region", "x", 0), -1.0, "not above 0"),
        (("region", "x"), [1.0], "not 2 sizes of x"),
        (("region",), {}, "not 2 sizes of x"),
        (("equations", "steps"), lambda steps: [*steps[:-1], ["number", 1.0]], "flow/|start|drift|x: "),
        (("plants",), "own", "plant.system.kind"),
    ],
)
def test_false_witnesses_of_a_region_are_rejected(
    witness: dict[str, Any], place: tuple[Any, ...], value: Any, reason: str
) -> None:
    changed = copy.deepcopy(witness)
    change(changed["statements"][0], place, value)
    with pytest.raises(ValueError, match=reason):
        list(check_file(changed, None, text_of(changed)))


@pytest.mark.parametrize("names", [["angle"], ["angle", "rate", "time"]])
def test_each_state_has_a_name_or_none_has(witness: dict[str, Any], names: list[str]) -> None:
    changed = copy.deepcopy(witness)
    del changed["scenario"]["outputs"]
    changed["scenario"]["model"]["state_names"] = names
    with pytest.raises(RefusedError, match="not 2 names"):
        list(check_file(changed, None, text_of(changed)))


def test_a_stronger_nonlinearity_is_another_plant(witness: dict[str, Any]) -> None:
    changed = copy.deepcopy(witness)
    steps = changed["statements"][0]["equations"]["steps"]
    [gravity] = [step for step in steps if step[:1] == ["number"] and step[1] > 9]
    gravity[1] *= 1.1
    with pytest.raises(RejectedError, match="flow/"):
        list(check_file(changed, None, text_of(changed)))


def test_a_bound_of_a_region_has_to_be_there_from_the_start_on(witness: dict[str, Any]) -> None:
    changed = copy.deepcopy(witness)
    del changed["statements"][0]["gains"]  # they bound x[0], too, but not below its limit
    bounds = changed["statements"][0]["bounds"]
    changed["statements"][0]["bounds"] = [entry for entry in bounds if entry["output"] != "x[0]"]
    with pytest.raises(RejectedError, match=r"region: x\[0\] has no bound"):
        list(check_file(changed, None, text_of(changed)))


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
    content = resolved_content(resolved)
    statement = find_statement(resolved, "region", "ideal")
    if not is_proven:  # the first input is 7.5 N m
        assert "|angle| ≤" in statement.reason
        assert "|torque| ≤" in statement.reason
        return
    assert statement.document is not None, statement.reason
    assert statement.document["region"]["u"][0] < limit  # type: ignore[index]
    bounds = statement.document["bounds"]
    assert isinstance(bounds, list)
    del statement.document["gains"]  # they bound u[0], too, but not below its limit
    less = {**statement.document, "bounds": [entry for entry in bounds if entry["output"] != "u[0]"]}
    file = {"scenario": content, "statements": [less]}
    with pytest.raises(RejectedError, match=r"region: u\[0\] has no bound"):
        list(check_file(file, None, text_of(file)))


def test_no_attack_exceeds_what_is_proven_on_a_region() -> None:
    statement = proved("sine_pendulum_schedule")
    step_s = float(arb(statement.loop.times.sampling))
    sizes = largest_sizes(statement.loop, pendulum, step_s=step_s, steps=600, runs=100)
    worst = largest_shares(sizes, statement.bounds, step_s)
    assert "x[0]" in worst  # of which the region has a limit
    assert max(worst.values()) < 1, worst
    assert min(worst[signal] for signal in ("x", "e_s", "e_c")) > 0.1
