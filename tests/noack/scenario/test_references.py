"""References: the regulator equations against closed forms, files, and what is refused."""

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import lsim

from noack.core.references import Reference
from noack.scenario.resolution import loop_of, reference_of, resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load
from tests.helpers.approved import compare_lines, lines_of_error

S = 10**9
SERVO = """
name = "servo"
horizon_s = 10.0
model.A = [[0.0, 1.0], [0.0, -2.0]]
model.B = [[0.0], [4.0]]
model.gain = [[-9.0, -2.5]]
model.state_names = ["angle", "speed"]
model.input_names = ["voltage"]
plant.initial_state = [0.0, 0.0]
trigger = { beta = 0.05, alpha_per_s = 0.5, floor = 0.01 }
network = { mansd = 3, loss = { model = "bernoulli", probability = 0.5 } }
"""


def servo(folder: Path, reference: str, *settings: str) -> Scenario:
    path = folder / "servo.toml"
    path.write_text(f"controller.reference = {reference}\n{SERVO}")
    return load(path, settings)


def followed(folder: Path, *pieces: str) -> Reference:
    reference = reference_of(resolve(servo(folder, f"[{', '.join(pieces)}]")))
    assert reference is not None
    return reference


def piece(kind: str, from_s: float, settings: str, output: str = "angle") -> str:
    return f'{{ kind = "{kind}", output = "{output}", from_s = {from_s}, {settings} }}'


def test_steps_ramps_and_sines_have_their_closed_forms(tmp_path: Path) -> None:
    """With ẋ_2 = −2 x_2 + 4 u: x_2 = ṙ and u = (r̈ + 2 ṙ)/4."""
    reference = followed(
        tmp_path,
        piece("step", 1.0, "value = 2.0"),
        piece("ramp", 2.0, "rate_per_s = 3.0, until_s = 4.0"),
        piece("sine", 5.0, "amplitude = 0.5, hz = 0.25, phase_rad = 0.3, offset = 1.0"),
    )
    assert reference.since_ns == [S, 2 * S, 4 * S, 5 * S]
    w = 2 * math.pi * 0.25
    phase = w * 1.7 + 0.3
    expected = {
        S // 2: [0, 0, 0],
        3 * S // 2: [2, 0, 0],
        3 * S: [5, 3, 1.5],
        9 * S // 2: [8, 0, 0],
        67 * S // 10: [
            1 + 0.5 * math.sin(phase),
            0.5 * w * math.cos(phase),
            0.5 * (-(w**2) * math.sin(phase) + 2 * w * math.cos(phase)) / 4,
        ],
    }
    for t_ns, row in expected.items():
        assert reference.rows(np.array([t_ns]))[0] == pytest.approx(row, abs=1e-12)


def test_each_segment_is_a_solution_of_the_model(tmp_path: Path) -> None:
    """Integrated by scipy from its begin to its end, with its own input."""
    reference = followed(
        tmp_path,
        piece("sine", 0.5, "amplitude = 1.0, hz = 0.7, join_s = 1.0"),
        piece("ramp", 4.0, "rate_per_s = -1.0"),
        piece("step", 6.0, "value = 0.5, join_s = 0.5"),
    )
    A, B = np.array([[0.0, 1.0], [0.0, -2.0]]), np.array([0.0, 4.0])
    ends_ns = [*reference.since_ns, 9 * S]
    for segment, end_ns in zip(reference.segments, ends_ns, strict=True):
        length_s = (end_ns - segment.begin_ns) / S
        end = solve_ivp(
            lambda t, x, part=segment: A @ x + B * part.at(t)[2],
            (0.0, length_s), segment.at(0.0)[:2], rtol=1e-10, atol=1e-11,
        ).y[:, -1]  # fmt: skip
        assert segment.at(length_s)[:2] == pytest.approx(end, abs=1e-8)


def test_a_joined_piece_begins_and_ends_without_a_jump(tmp_path: Path) -> None:
    reference = followed(
        tmp_path,
        piece("sine", 1.0, "amplitude = 1.0, hz = 0.5, join_s = 1.0"),
        piece("step", 4.0, "value = 3.0, join_s = 2.0"),
    )
    for place, t_ns in enumerate(reference.since_ns):
        assert reference.in_segment(place, t_ns) == pytest.approx(reference.state(t_ns), abs=1e-9)
    plain = followed(tmp_path, piece("sine", 1.0, "amplitude = 1.0, hz = 0.5"))
    assert reference.state(3 * S) == pytest.approx(plain.state(3 * S), abs=1e-9)
    assert reference.state(6 * S) == pytest.approx([3.0, 0.0], abs=1e-12)


def test_where_the_plant_integrates_an_output_its_position_moves_on(tmp_path: Path) -> None:
    """A step of the speed: the angle is a ramp, which begins where the angle was."""
    pieces = (piece("step", 1.0, "value = 2.0", "speed"), piece("step", 3.0, "value = 0.0", "speed"))
    reference = followed(tmp_path, *pieces)
    assert reference.state(2 * S) == pytest.approx([2.0, 2.0])
    assert reference.state(5 * S) == pytest.approx([4.0, 0.0])


def rows_of_a_solution(t_s: np.ndarray) -> np.ndarray:
    u = np.sin(t_s)
    system = ([[0.0, 1.0], [0.0, -2.0]], [[0.0], [4.0]], np.eye(2), np.zeros((2, 1)))
    _, x, _ = lsim(system, u, t_s)
    return np.column_stack([t_s, x, u])


def write(path: Path, rows: np.ndarray, header: str = "t_s,angle,speed,voltage") -> None:
    lines = [",".join(map(repr, row)) for row in rows.tolist()]
    path.write_text("\n".join([header, *lines]) + "\n")


def test_a_file_is_followed_between_its_rows_too(tmp_path: Path) -> None:
    write(tmp_path / "moves.csv", rows_of_a_solution(np.linspace(0, 10, 1001)))
    scenario = servo(tmp_path, '[{ kind = "file", file = "moves.csv" }]')
    (tmp_path / "moves.csv").unlink()  # a loaded scenario has its numbers
    reference = loop_of(resolve(scenario)).reference
    assert reference is not None
    fine = rows_of_a_solution(np.linspace(0, 10, 10_001))
    rows = reference.rows(np.round(fine[:, 0] * S).astype(np.int64))
    assert rows == pytest.approx(fine[:, 1:], abs=5e-5)  # the inputs of 10 times as many rows differ


def test_what_is_wrong_is_refused_with_the_approved_line(tmp_path: Path) -> None:
    rows = rows_of_a_solution(np.linspace(0, 10, 1001))
    write(tmp_path / "columns.csv", rows, "t_s,angle,velocity,voltage")
    write(tmp_path / "short.csv", rows[:500])
    write(tmp_path / "back.csv", np.insert(rows, 500, rows[400], axis=0))
    (tmp_path / "numbers.csv").write_text("t_s,angle,speed,voltage\n0,0,0,0\n1,0,x,0\n")
    rows[700, 1] += 0.01
    write(tmp_path / "jump.csv", rows)

    def refusal(line: str) -> list[str]:
        reference, *settings = line.split(" & ")
        return lines_of_error(lambda: servo(tmp_path, reference, *settings), FOLDER=tmp_path)

    compare_lines(Path(__file__).with_name("reference_mistakes.txt"), refusal)
