"""Matrices from files, and from objects of python-control and SciPy."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import signal
from scipy.io import loadmat, savemat
from scipy.linalg import expm
from scipy.sparse import csc_matrix

from netem.core.errors import CallerError
from noack.scenario.matrix_files import controller_of, model_of, save_model
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import dumps, load
from noack.scenario.sections import ModelSection
from tests.helpers.approved import compare_lines, lines_of_error

A = np.array([[0.0, 1.0], [4.0, -0.25]])
B = np.array([[0.0], [1.0]])
K = np.array([[-8.0, -4.0]])
TEXT = """
name = "filed"
horizon_s = 1.0
trigger = {{ beta = 0.05, alpha_per_s = 0.5 }}
network = {{ mansd = 3, loss = {{ model = "lossless" }} }}
[model]
{model}
[plant]
initial_state = [1.0, 0.0]
{plant}
"""


def scenario(folder: Path, model: str, plant: str = "") -> Scenario:
    path = folder / "filed.toml"
    path.write_text(TEXT.format(model=model, plant=plant))
    return load(path)


@pytest.mark.parametrize("gain", ["gain", "K"])
def test_model_and_plant_may_come_from_two_files(gain: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "model.npz", A=A, B=B, C=C, D=D, **{gain: K})  # type: ignore[arg-type]
    np.savez(tmp_path / "true.npz", A=A + 0.1, B=B + 0.1, unrelated="text")
    loaded = scenario(tmp_path, 'file = "model.npz"', 'file = "true.npz"\ndraw = "given"')
    assert loaded.model.file is None
    resolved = resolve(loaded)
    for key, expected in (("A", A), ("B", B), ("gain", K)):
        assert np.array_equal(np.array(getattr(resolved.model, key)), expected)
    assert np.array_equal(np.array(resolved.plant.A), A + 0.1)
    assert np.array_equal(np.array(resolved.plant.B), B + 0.1)
    (tmp_path / "again.toml").write_text(dumps(resolved))
    assert load(tmp_path / "again.toml") == resolved


@pytest.mark.parametrize("compressed", [False, True])
def test_a_mat_file_may_have_sparse_matrices_integers_and_text(compressed: bool, tmp_path: Path) -> None:
    content = {"A": csc_matrix(A), "B": B.astype(np.int8), "K": K, "unrelated": "text", "file": K}
    savemat(tmp_path / "m.mat", content, do_compression=compressed)
    loaded = scenario(tmp_path, 'file = "m.mat"')
    assert np.array_equal(np.array(loaded.model.A), A)
    assert (loaded.model.B, loaded.model.gain) == (((0.0,), (1.0,)), ((-8.0, -4.0),))


CRASHES = Path(__file__).parents[2] / "cases" / "segv.mat"
"""SciPy reads the imaginary part of B, of which the file has only the flag: a segmentation fault."""


@pytest.mark.parametrize(
    "content", [CRASHES.read_bytes(), CRASHES.read_bytes()[:200], b"MATLAB", b""],
    ids=["crashes", "ends early", "text", "empty"],
)  # fmt: skip
def test_a_damaged_mat_file_is_refused_in_one_line(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "m.mat").write_bytes(content)
    assert lines_of_error(lambda: scenario(tmp_path, 'file = "m.mat"')) == [
        f'{tmp_path / "filed.toml"}: model.file = "m.mat": is not a .mat file, or is damaged'
    ]


@pytest.mark.parametrize(
    ("arrays", "expected"),
    [
        ({"A": A}, "has no matrix B of numbers, at most 64 x 64; it has A"),
        ({"A": A, "B": B, "K": K, "dt": 0.01}, "dt is 0.01, so it is a system in discrete time"),
        ({"A": A, "B": B, "K": K, "C": np.eye(2)[:1]}, "C is not the identity"),
        ({"A": A, "B": B, "K": K, "D": np.ones((2, 1))}, "D is not zero"),
        ({"A": A * 1j, "B": B}, "A must have real numbers only"),
        ({"A": A, "B": B + np.inf}, "B has entries that are not finite"),
        ({"A": A, "B": B, "gain": K, "K": 2 * K}, "has gain and K; say which by names = { gain"),
        ({"A": A, "B": B, "K": K.T}, "gain = [[-8.0], [-4.0]]: expected 1 x 2"),
    ],
)
def test_a_file_without_a_valid_system_is_refused_in_one_line(
    arrays: dict[str, Any], expected: str, tmp_path: Path
) -> None:
    np.savez(tmp_path / "m.npz", **arrays)
    (line,) = lines_of_error(lambda: scenario(tmp_path, 'file = "m.npz"'))
    assert expected in line
    assert "filed.toml: model." in line


def test_a_wrong_file_or_key_is_refused_with_the_approved_lines(tmp_path: Path) -> None:
    np.savez(tmp_path / "m.npz", A=A, B=B, K=K)
    np.savez(tmp_path / "flat.npz", A=A, B=B[:, 0], K=K)
    np.savez(tmp_path / "pickled.npz", A=np.array([[object()]], dtype=object), B=B)
    (tmp_path / "bad.npz").write_bytes(b"PK\x03\x04nothing")
    header = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
    (tmp_path / "hdf.mat").write_bytes(header + bytes(512))

    def refusal(model: str) -> list[str]:
        keys = model.replace(" & ", "\n")
        return lines_of_error(lambda: scenario(tmp_path, keys), FOLDER=tmp_path)

    compare_lines(Path(__file__).with_name("matrix_mistakes.txt"), refusal)


C, D = np.eye(2), np.zeros((2, 1))
EXPECTED = ModelSection(A=((0.0, 1.0), (4.0, -0.25)), B=((0.0,), (1.0,)), gain=((-8.0, -4.0),))


def control_object(**attributes: Any) -> Any:
    """An object with the attributes of a python-control system."""
    return SimpleNamespace(A=A, B=B, C=C, D=D, **attributes)


ROTATION = np.linalg.qr(np.arange(1.0, 10.0).reshape(3, 3) ** 0.5)[0]


def test_the_units_of_states_do_not_matter_for_a_sampled_system() -> None:
    rates, units = (
        np.array([[-1.0, 3.0, 0.0], [0.0, -2.0, 1.0], [0.5, 0.0, -40.0]]),
        np.diag([1e5, 1e-4, 1.0]),
    )
    steps = expm(0.1 * rates)
    in_units = units @ steps @ np.linalg.inv(units)
    system = SimpleNamespace(A=in_units, B=np.ones((3, 1)), C=np.eye(3), D=np.zeros((3, 1)), dt=0.1)
    found = np.linalg.inv(units) @ np.array(model_of(system, np.zeros((1, 3))).A) @ units
    assert found == pytest.approx(rates, abs=1e-7)


def systems() -> dict[str, Any]:
    return {
        "two": (A, B),
        "scipy": signal.StateSpace(A, B, C, D),
        "default names": control_object(dt=0, state_labels=["x[0]", "x[1]"], input_labels=["u[0]"]),
    }


@pytest.mark.parametrize("name", systems())
def test_a_system_of_a_library_or_a_tuple_is_accepted_as_a_model(name: str) -> None:
    assert model_of(systems()[name], K) == EXPECTED


@pytest.mark.parametrize(("suffix", "read"), [(".npz", np.load), (".mat", loadmat)])
def test_a_saved_system_is_read_back(suffix: str, read: Any, tmp_path: Path) -> None:
    path = tmp_path / f"plant{suffix}"
    save_model(path, signal.StateSpace(A, B, C, D), K)
    matrices = read(path)
    for name, expected in (("A", A), ("B", B), ("gain", K)):
        assert np.array_equal(matrices[name], expected)
    save_model(path, (A, B))
    assert "gain" not in read(path)


def test_what_python_control_returns_goes_in_as_it_is() -> None:
    control = pytest.importorskip("control")
    system = control.ss(A, B, C, D)
    design = control.lqr(system, np.eye(2), [[1.0]])
    assert model_of(system, design).gain == model_of(system, -design[0]).gain
    sampled = control.c2d(system, 0.01)
    for each in (sampled, signal.StateSpace(sampled.A, sampled.B, C, D, dt=0.01)):
        found = model_of(each, control.dlqr(sampled, np.eye(2), [[1.0]]))
        assert np.array(found.A) == pytest.approx(A, abs=1e-9)
        assert np.array(found.B) == pytest.approx(B, abs=1e-9)
    placed = signal.place_poles(A, B, [-2.0, -3.0])
    closed_loop = A + B @ np.array(model_of((A, B), placed).gain)
    assert sorted(np.linalg.eigvals(closed_loop).real) == pytest.approx([-3.0, -2.0])
    with pytest.raises(CallerError, match="u = -K x does"):
        model_of((A, B), control.place(A, B, [-2.0, -3.0]))


@pytest.mark.parametrize(
    ("matrix", "dt", "message"),
    [
        ([[-0.5]], 0.1, "dt: a step of it has no real logarithm: no linear system in continuous time"),
        ([[0.0]], 0.1, "dt: a step of it has no real logarithm"),  # u acts at the next sample, for one sample
        (np.diag([0.9, 0.0]), 0.1, "dt: a step of it has no real logarithm"),
        # x⁺ = 0.905 x + 0.095 z, z⁺ = u: a dead time of one sample.
        ([[0.905, 0.095], [0.0, 0.0]], 0.1, "dt: a step of it has no real logarithm"),
        # The same in other coordinates: the eigenvalue is only nearly 0.
        ([[0.8, -0.35], [-0.24, 0.105]], 0.1, "dt: a step of it has no real logarithm"),
        # A dead time of three samples in other coordinates: the eigenvalues are of the size 1e-5.
        (ROTATION @ np.eye(3, k=1) @ ROTATION.T, 0.1, "dt: a step of it has no real logarithm"),
        ([[0.5]], True, "time is not stated"),
    ],
)
def test_samples_of_no_system_are_refused(matrix: Any, dt: Any, message: str) -> None:
    n = len(matrix)
    system = SimpleNamespace(A=matrix, B=np.ones((n, 1)), C=np.ones((1, n)), D=[[0.0]], dt=dt)
    with pytest.raises(CallerError, match=message):
        model_of(system, -np.ones((1, n)))
    with pytest.raises(CallerError, match=message):
        controller_of(system)


def test_a_controller_in_discrete_time_is_taken_back() -> None:
    exact = (np.array([[-1.0]]), np.array([[2.0, 0.0]]), [[3.0]], [[0.0, 0.0]])
    sampled = signal.cont2discrete(exact, 0.02)[:2]
    given = SimpleNamespace(A=sampled[0], B=sampled[1], C=exact[2], D=exact[3], dt=0.02)
    table = controller_of(given)
    assert np.array(table["A"]) == pytest.approx(exact[0])
    assert np.array(table["B"]) == pytest.approx(exact[1], abs=1e-9)
