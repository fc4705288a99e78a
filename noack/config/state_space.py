"""Models from state-space objects of python-control and SciPy, and files with such models.

An object has the matrices A, B, C and D and, in discrete time, dt. It is a ``control.StateSpace``,
a ``scipy.signal.StateSpace``, or a tuple (A, B, C, D) or (A, B). The loop is in continuous time and
measures the state, so C must be the identity and D zero. The loop's input is u = K x, but
``control.lqr`` and ``scipy.signal.place_poles`` return the gain of u = -K x.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from noack.config.matrix_files import GAIN, unfit, write_matrices
from noack.config.sections.model_section import ModelSection, instability
from noack.config.validation_messages import brief
from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix
from noack.settings.matrices import require_shape, rows_of


def model_of(
    system: Any,
    gain: Any,
    *,
    state_names: Sequence[str] | None = None,
    input_names: Sequence[str] | None = None,
) -> ModelSection:
    """Return the model section of a scenario for a system and the gain K of u = K x, (m, n).

    The names are for plots; by default they are those in a python-control object, if it has any.

    Raises:
        CallerError: the object is not such a system; the shapes do not fit; or u = K x does not
            stabilise it.
    """
    states = state_names or _labels(system, "state_labels")
    inputs = input_names or _labels(system, "input_labels")
    matrices = matrices_of(system, gain)
    try:
        return ModelSection(
            A=rows_of(matrices["A"]),
            B=rows_of(matrices["B"]),
            gain=rows_of(matrices[GAIN]),
            state_names=None if states is None else tuple(states),
            input_names=None if inputs is None else tuple(inputs),
        )
    except ValidationError as error:
        raise CallerError(f"the system: {brief(error)}") from None


def save_model(path: str | Path, system: Any, gain: Any = None) -> None:
    """Write an ``.npz`` or ``.mat`` file for ``model.file`` or ``plant.file`` of a scenario.

    Without the gain K of u = K x, (m, n), the scenario must give it. Raise CallerError as
    :func:`model_of` does, and if the file cannot be written.
    """
    try:
        write_matrices(Path(path), matrices_of(system, gain))
    except (OSError, ValueError) as error:
        raise CallerError(f"{path}: cannot be written: {error}") from None


def matrices_of(system: Any, gain: Any = None) -> dict[str, Matrix]:
    """Return the matrices of a system by name: A, (n, n), B, (n, m), and the gain if given, (m, n).

    Arguments and errors are those of :func:`model_of`.
    """
    if isinstance(system, tuple):
        if len(system) not in (2, 4):
            raise CallerError(f"the system: a tuple of {len(system)}; give (A, B) or (A, B, C, D)")
        A, B, C, D = (*system, None, None)[:4]
        dt = None
    else:
        missing = [key for key in ("A", "B", "C", "D") if not hasattr(system, key)]
        if missing:
            raise CallerError(
                f"the system: an object of type {type(system).__name__} has no {missing[0]}; "
                "give a state space, e.g. with .to_ss(), control.ss, or a tuple (A, B, C, D)"
            )
        A, B, C, D, dt = system.A, system.B, system.C, system.D, getattr(system, "dt", None)
    found = {"A": _matrix("A", A), "B": _matrix("B", B)}
    n, m = found["B"].shape
    try:
        require_shape(rows_of(found["A"]), "A", (n, n), "B has a row for each state")
        if gain is not None:
            found[GAIN] = _matrix(GAIN, gain)
            require_shape(rows_of(found[GAIN]), GAIN, (m, n), "a row per input, a column per state")
    except ValueError as error:
        raise CallerError(f"the system: {error}") from None
    if (why := unfit(C, D, dt, n)) is not None:
        raise CallerError(f"the system: {why}")
    if gain is not None and (why := instability(found["A"], found["B"], found[GAIN])) is not None:
        raise CallerError(f"gain: {why}")
    return found


def _matrix(name: str, value: Any) -> Matrix:
    try:
        found = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise CallerError(f"{name}: is not a matrix of real numbers") from None
    if found.ndim != 2 or not found.size or not np.isfinite(found).all():
        raise CallerError(
            f"{name}: a matrix of finite numbers is needed, by rows: [[1, 2], [3, 4]]"
        )
    return found


def _labels(system: Any, key: str) -> Sequence[str] | None:
    """Return the names that the user chose; None for the default names of python-control."""
    labels = getattr(system, key, None)
    return None if not labels or any("[" in label for label in labels) else labels
