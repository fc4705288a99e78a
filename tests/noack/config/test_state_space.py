"""Models from objects of python-control and SciPy."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import signal
from scipy.io import loadmat

from noack.config.matrix_files import model_of, save_model
from noack.config.sections import ModelSection
from noack.core.errors import CallerError

A = np.array([[0.0, 1.0], [4.0, 0.0]])
B = np.array([[0.0], [1.0]])
C, D = np.eye(2), np.zeros((2, 1))
K = np.array([[-8.0, -4.0]])
EXPECTED = ModelSection(A=((0.0, 1.0), (4.0, 0.0)), B=((0.0,), (1.0,)), gain=((-8.0, -4.0),))


def control_object(**attributes: Any) -> Any:
    """An object with the attributes of a python-control system."""
    return SimpleNamespace(A=A, B=B, C=C, D=D, **attributes)


def systems() -> dict[str, Any]:
    return {
        "two": (A, B),
        "four": (A, B, C, D),
        "lists": (A.tolist(), B.tolist()),
        "scipy": signal.StateSpace(A, B, C, D),
        "lti": signal.lti(A, B, C, D),
        "default names": control_object(dt=0, state_labels=["x[0]", "x[1]"], input_labels=["u[0]"]),
    }


@pytest.mark.parametrize("name", systems())
def test_a_system_of_a_library_or_a_tuple_is_accepted_as_a_model(name: str) -> None:
    assert model_of(systems()[name], K) == EXPECTED


def test_the_names_of_a_python_control_system_are_used_by_default() -> None:
    named = control_object(dt=0, state_labels=["angle", "rate"], input_labels=["torque"])
    model = model_of(named, K)
    assert (model.state_names, model.input_names) == (("angle", "rate"), ("torque",))
    assert model_of(named, K, state_names=["p", "q"]).state_names == ("p", "q")


@pytest.mark.parametrize(("suffix", "read"), [(".npz", np.load), (".mat", loadmat)])
def test_a_saved_system_is_read_back(suffix: str, read: Any, tmp_path: Path) -> None:
    path = tmp_path / f"plant{suffix}"
    save_model(path, signal.StateSpace(A, B, C, D), K)
    found = read(path)
    for name, expected in (("A", A), ("B", B), ("gain", K)):
        assert np.array_equal(found[name], expected)
    save_model(path, (A, B))
    assert "gain" not in read(path)


@pytest.mark.parametrize(
    ("system", "gain", "expected"),
    [
        (signal.StateSpace(A, B, C, D, dt=0.1), K, "dt is 0.1, so it is a system in discrete time"),
        (signal.StateSpace(A, B, C[:1], D[:1]), K, "C is not the identity"),
        (signal.StateSpace(A, B, C, D + 1), K, "D is not zero"),
        (signal.TransferFunction([1.0], [1.0, 2.0]), K, "TransferFunctionContinuous has no A"),
        (control_object(dt=True), K, "discrete time; the loop is in continuous time (MATLAB: d2c)"),
        ((A, B), -K, "u = K x does not stabilise the model"),
        ((A, B), -K, "u = -K x does: give -K"),
        ((A, B, C), K, "a tuple of 3"),
        ((A, B[:, 0]), K, "B: a matrix of finite numbers is needed"),
        ((A[:1], B), K, "expected 2 x 2 (B has a row for each state), found 1 x 2"),
        ((A, B), K.T, "gain: expected 1 x 2"),
        ((A, "B"), K, "B: is not a matrix of real numbers"),
        ((A * np.nan, B), K, "A: a matrix of finite numbers is needed"),
    ],
)
def test_an_invalid_system_is_refused_in_one_line(system: Any, gain: Any, expected: str) -> None:
    with pytest.raises(CallerError) as refused:
        model_of(system, gain)
    assert expected in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_wrong_file_type_or_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CallerError, match=r"must end in \.npz"):
        save_model(tmp_path / "plant.csv", (A, B))
    with pytest.raises(CallerError, match="cannot be written"):
        save_model(tmp_path / "nowhere" / "plant.npz", (A, B))
