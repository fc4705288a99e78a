"""Matrices from files (``.npz``, and ``.mat`` up to MATLAB's v7), and from state-space objects.

A file has a system ẋ = A x + B u and, optionally, the gain K of u = K x. An object is a
``control.StateSpace``, a ``scipy.signal.StateSpace``, or a tuple (A, B, C, D) or (A, B). In a
complete state-space model C must be the identity and D zero, because the loop measures x. A file is in
continuous time; an object in discrete time, as ``control.c2d`` returns it, is taken back to continuous
time. The loop's input is u = K x, but ``control.lqr`` and ``scipy.signal.place_poles`` return the gain of
u = -K x: what they return as a whole has the right sign, a matrix alone is taken as it is.
"""

import io
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import ValidationError

from netem.core.errors import CallerError, why
from netem.core.file_access import new_file
from netem.core.named_file import NamedFile
from netem.core.settings_section import ReadTable
from netem.core.toml_file import brief
from noack.core.linear_systems import Matrix, real_logarithm
from noack.protocol.wire_format import MAX_DIMENSION
from noack.scenario.mat_file import arrays_of_mat
from noack.scenario.sections import ModelSection, instability
from noack.settings.values import require_shape, rows_of

Arrays = dict[str, NDArray[np.generic]]
NPZ, MAT = ".npz", ".mat"
GAIN = "gain"
_GAINS = (GAIN, "K")
_MOST_ENTRIES = MAX_DIMENSION**2
_MOST_BYTES = 16 * _MOST_ENTRIES + 65_536
"""Largest size of an array within an archive, including its header."""
_MOST_ARRAYS = 1000
_DIRECTORY_ENTRY = b"PK\1\2"
"""Begins each entry of an archive's directory."""
_NUMBERS = "fiub"


def with_matrices(content: ReadTable, folder: Path, source: str) -> ReadTable:
    """Return a scenario's content with the matrices of the files that it names.

    ``model.file`` gives A, B and, unless the scenario has one, the gain; ``plant.file`` gives A and
    B, ``controller.file`` of a state-space controller A, B, C and D. Names are relative to ``folder``.
    Invalid content is returned unchanged. If a file cannot be read or lacks a matrix, CallerError has
    one line, which begins with ``source``.
    """
    updated = dict(content)
    if isinstance(loops := content.get("loops"), list):
        updated["loops"] = [
            with_matrices(loop, folder, f"{source}: loops.{index}") if _is_flat(loop) else loop
            for index, loop in enumerate(loops)
        ]
    for table, keys in (("model", ("A", "B", GAIN)), ("plant", ("A", "B"))):
        section = content.get(table)
        if isinstance(section, Mapping) and (names := _names(section)) is not None:
            file = NamedFile(section["file"], folder, f"{source}: {table}")
            updated[table] = _with_file(section, keys, file, names)
    controller = content.get("controller")
    if isinstance(controller, Mapping) and controller.get("kind") == "state_space":
        updated["controller"] = _with_controller(controller, folder, f"{source}: controller")
    return updated


def _with_controller(section: ReadTable, folder: Path, place: str) -> ReadTable:
    """Return a controller's table with the matrices A, B, C and D of its file."""
    name = section.get("file")
    if not isinstance(name, str):
        return section
    file = NamedFile(name, folder, place)
    if twice := [key for key in "ABCD" if key in section]:
        file.wrong(f"the file has {twice[0]}, and so has the scenario; give one or the other")
    arrays = _arrays(file)
    if missing := [key for key in "ABC" if key not in arrays]:
        file.wrong(_missing(missing[0], arrays))
    if (reason := _discrete(arrays.get("dt"))) is not None:
        file.wrong(reason)
    matrices = {key: _matrix(file, key, arrays[key]).tolist() for key in "ABCD" if key in arrays}
    return {key: value for key, value in section.items() if key != "file"} | matrices


def _is_flat(loop: object) -> bool:
    """Whether an entry of [[loops]] is a table without loops of its own."""
    return isinstance(loop, Mapping) and "loops" not in loop


def _names(section: ReadTable) -> Mapping[str, str] | None:
    """Return the names of the matrices in a section's file.

    None if it names no file, or has an incorrect entry, which the validation refuses.
    """
    names = section.get("names", {})
    if not isinstance(section.get("file"), str) or not isinstance(names, Mapping):
        return None
    are_names = all(isinstance(name, str) for name in names.values())
    return names if are_names and names.keys() <= {"A", "B", GAIN} else None


def _with_file(
    section: ReadTable, keys: tuple[str, ...], file: NamedFile, names: Mapping[str, str]
) -> ReadTable:
    for key in ("A", "B"):
        if key in section:
            file.wrong(f"the file has {key}, and so has the scenario; give one or the other")
    matrices = read_matrices(file, names)
    other_settings = {key: value for key, value in section.items() if key not in ("file", "names")}
    return {key: matrices[key].tolist() for key in keys if key in matrices} | other_settings


def read_matrices(file: NamedFile, names: Mapping[str, str] | None = None) -> dict[str, Matrix]:
    """Read A, B and, if there is one, the gain (named gain or K, or as ``names`` says).

    Raises:
        CallerError: the file cannot be read or lacks a matrix; or C is not the identity, D is not
            zero, or the time is not continuous.
    """
    names = names or {}
    arrays = _arrays(file)
    matrices: dict[str, Matrix] = {}
    for key in ("A", "B"):
        name = names.get(key, key)
        if name not in arrays:
            file.wrong(_missing(name, arrays))
        matrices[key] = _matrix(file, name, arrays[name])
    if GAIN in names and names[GAIN] not in arrays:
        file.wrong(_missing(names[GAIN], arrays))
    gains = [name for name in (_GAINS if GAIN not in names else (names[GAIN],)) if name in arrays]
    if len(gains) > 1:
        file.wrong(f'has {" and ".join(gains)}; say which by names = {{ gain = "…" }}')
    for name in gains:
        matrices[GAIN] = _matrix(file, name, arrays[name])
    C, D, dt = (arrays.get(key) for key in ("C", "D", "dt"))
    if (reason := unfit(C, D, dt, len(matrices["A"]))) is not None:
        file.wrong(reason)
    return matrices


def unfit(C: ArrayLike | None, D: ArrayLike | None, dt: ArrayLike | None, n: int) -> str | None:
    """Return why the loop cannot use a state-space model of n states; None if it can.

    C, D and the sampling time dt may be None; dt = 0 is continuous time.
    """
    if (reason := _discrete(dt)) is not None:
        return reason
    if C is not None and (np.shape(C) != (n, n) or not np.array_equal(C, np.eye(n))):
        return (
            "C is not the identity, but the loop measures the state; where C has an inverse, "
            "take C A C^-1 and C B for A and B"
        )
    if D is not None and np.any(np.asarray(D) != 0):
        return "D is not zero, but what the loop measures is the state alone"
    return None


def _discrete(dt: ArrayLike | None) -> str | None:
    """Return why a system with this sampling time cannot be used; None if it is in continuous time."""
    if dt is None or not np.any(np.asarray(dt) != 0):
        return None
    return (
        f"dt is {np.asarray(dt).ravel()[0]}, so it is a system in discrete time; "
        "the loop is in continuous time (MATLAB: d2c)"
    )


def write_matrices(path: Path, matrices: Mapping[str, Matrix]) -> None:
    """Write matrices to an ``.npz`` or ``.mat`` file; raise ValueError for another suffix."""
    if path.suffix not in (NPZ, MAT):
        raise ValueError(_SUFFIXES)
    with new_file(path, make_folder=False) as file:
        if path.suffix == NPZ:
            np.savez(file, allow_pickle=False, **matrices)
        else:
            from scipy.io import savemat  # imported here: it takes time and memory

            savemat(file, dict(matrices))  # type: ignore[arg-type] # accepts files, too


_SUFFIXES = f"must end in {NPZ} (NumPy) or {MAT} (MATLAB)"


def _arrays(file: NamedFile) -> Arrays:
    if file.path.suffix not in (NPZ, MAT):
        file.wrong(_SUFFIXES)
    content = file.content()
    arrays = content.count(_DIRECTORY_ENTRY) if file.path.suffix == NPZ else 0
    if arrays > _MOST_ARRAYS:
        file.wrong(f"has {arrays:,} arrays; at most {_MOST_ARRAYS:,} are read")
    try:
        return _npz_arrays(arrays_of_mat(content, _MOST_ENTRIES) if file.path.suffix == MAT else content)
    except NotImplementedError:
        file.wrong("is of MATLAB's v7.3, which is HDF5; save it as v7: save(name, '-v7')")
    except Exception:  # an invalid file can raise any error
        file.wrong(f"is not a {file.path.suffix} file, or is damaged")


def _npz_arrays(content: bytes) -> Arrays:
    """Return the arrays that are not too large, by name."""
    arrays = {}
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        for entry in archive.infolist():
            name = entry.filename.removesuffix(".npy")
            if name != entry.filename and entry.file_size <= _MOST_BYTES:
                array = io.BytesIO(archive.read(entry))
                version = np.lib.format.read_magic(array)
                read_header = _HEADERS[version]
                shape, _, kind = read_header(array)
                if np.prod(shape, dtype=float) <= _MOST_ENTRIES and kind.kind in _NUMBERS + "c":
                    array.seek(0)
                    arrays[name] = np.lib.format.read_array(array, allow_pickle=False)
    return arrays


_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


def _matrix(file: NamedFile, name: str, value: NDArray[np.generic]) -> Matrix:
    if value.dtype.kind not in _NUMBERS:
        file.wrong(f"{name} must have real numbers only")
    if value.ndim != 2 or not value.size:
        shape = " x ".join(map(str, value.shape)) or "no"
        file.wrong(f"{name} has {shape} entries; a matrix is needed, with rows and columns")
    if not np.isfinite(value).all():
        file.wrong(f"{name} has entries that are not finite")
    return np.asarray(value, dtype=np.float64)


def _missing(name: str, arrays: Arrays) -> str:
    listed = ", ".join(list(arrays)[:10]) or "none"
    most = f"{MAX_DIMENSION} x {MAX_DIMENSION}"
    return f"has no matrix {name} of numbers, at most {most}; it has {listed}"


def model_of(
    system: object,
    gain: object,
    *,
    state_names: Sequence[str] | None = None,
    input_names: Sequence[str] | None = None,
) -> ModelSection:
    """Return the model section of a scenario for a system and the gain K of u = K x, (m, n).

    The gain is a matrix, or the result of ``control.lqr``, ``control.dlqr`` or ``scipy.signal.place_poles``.
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


def save_model(path: str | Path, system: object, gain: object = None) -> None:
    """Write an ``.npz`` or ``.mat`` file for ``model.file`` or ``plant.file`` of a scenario.

    Without the gain K of u = K x, (m, n), the scenario must give it. Raise CallerError as
    :func:`model_of` does, and if the file cannot be written.
    """
    try:
        write_matrices(Path(path), matrices_of(system, gain))
    except (OSError, ValueError) as error:
        raise CallerError(f"{path}: cannot be written: {why(error)}") from None


def matrices_of(system: object, gain: object = None) -> dict[str, Matrix]:
    """Return the matrices of a system by name: A, (n, n), B, (n, m), and the gain if given, (m, n).

    Arguments and errors are those of :func:`model_of`.
    """
    A, B, C, D, dt = _parts(system, "the system", (2, 4))
    matrices = {"A": _finite_matrix("A", A), "B": _finite_matrix("B", B)}
    n, m = matrices["B"].shape
    try:
        require_shape(rows_of(matrices["A"]), "A", (n, n), "B has a row for each state")
        matrices["A"], matrices["B"] = _in_continuous_time(matrices["A"], matrices["B"], dt)
        if gain is not None:
            matrices[GAIN] = _gain(gain)
            require_shape(rows_of(matrices[GAIN]), GAIN, (m, n), "a row per input, a column per state")
    except ValueError as error:
        raise CallerError(f"the system: {error}") from None
    if (reason := unfit(C, D, None, n)) is not None:
        raise CallerError(f"the system: {reason}")
    if gain is not None and (reason := instability(matrices["A"], matrices["B"], matrices[GAIN])) is not None:
        raise CallerError(f"gain: {reason}")
    return matrices


def _gain(given: Any) -> Matrix:
    """Return K of u = Kx from a matrix, or from a library's (K, S, E) or object, whose K is of u = −Kx."""
    if isinstance(given, tuple) and len(given) == 3 and np.ndim(given[0]) == 2:
        return -_finite_matrix(GAIN, given[0])
    if hasattr(given, "gain_matrix"):
        return -_finite_matrix(GAIN, given.gain_matrix)
    return _finite_matrix(GAIN, given)


def _in_continuous_time(A: Matrix, B: Matrix, dt: ArrayLike | None) -> tuple[Matrix, Matrix]:
    """Return the system whose samples, with an input that is held, are those of one with a sampling time.

    Raises:
        ValueError: there is none, or the sampling time is not stated.
    """
    if _discrete(dt) is None:
        return A, B
    if isinstance(dt, bool | np.bool_) or not float(np.asarray(dt).ravel()[0]) > 0:
        raise ValueError("dt: the sampling time is not stated; give it in seconds")
    (n, m), step_s = B.shape, float(np.asarray(dt).ravel()[0])
    logarithm = real_logarithm(np.block([[A, B], [np.zeros((m, n)), np.eye(m)]]))
    if logarithm is None:
        raise ValueError(
            "dt: a step of it has no real logarithm: no linear system in continuous time has these samples; "
            "give the continuous one"
        )
    rate = logarithm / step_s
    return rate[:n, :n], rate[:n, n:]


def _parts(system: object, what: str, sizes: tuple[int, ...]) -> Sequence[Any]:
    """Return A, B, C, D and dt of an object or a tuple; what it does not have is None."""
    if isinstance(system, tuple):
        if len(system) not in sizes:
            forms = " or ".join(f"({', '.join('ABCD'[:size])})" for size in sizes)
            raise CallerError(f"{what}: a tuple of {len(system)}; give {forms}")
        return (*(*system, None, None)[:4], None)
    if missing := [key for key in "ABCD" if not hasattr(system, key)]:
        raise CallerError(
            f"{what}: an object of type {type(system).__name__} has no {missing[0]}; "
            "give a state space, e.g. with .to_ss(), control.ss, or a tuple (A, B, C, D)"
        )
    return [getattr(system, key, None) for key in ("A", "B", "C", "D", "dt")]


def controller_of(system: object) -> dict[str, object]:
    """Return the table ``controller`` of a scenario for a linear controller with states of its own.

    Args:
        system: dξ/dt = A ξ + B x, u = C ξ + D x: a tuple (A, B, C) or (A, B, C, D), or an object of
            python-control or SciPy. Without D, u = C ξ + K x.

    Raises:
        CallerError: it is none, or no system in continuous time has its samples.
    """
    *matrices, dt = _parts(system, "controller", (3, 4))
    named = {
        key: _finite_matrix(f"controller.{key}", M)
        for key, M in zip("ABCD", matrices, strict=True) if M is not None
    }  # fmt: skip
    if len(named["A"]) == len(named["A"].T) == len(named["B"]):
        try:
            named["A"], named["B"] = _in_continuous_time(named["A"], named["B"], dt)
        except ValueError as error:
            raise CallerError(f"controller: {error}") from None
    return {"kind": "state_space", **{key: M.tolist() for key, M in named.items()}}


def _finite_matrix(name: str, value: ArrayLike) -> Matrix:
    try:
        matrix = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise CallerError(f"{name}: is not a matrix of real numbers") from None
    if matrix.ndim != 2 or not matrix.size or not np.isfinite(matrix).all():
        raise CallerError(f"{name}: a matrix of finite numbers is needed, by rows: [[1, 2], [3, 4]]")
    return matrix


def _labels(system: object, key: str) -> Sequence[str] | None:
    """Return the names that the user chose; None for the default names of python-control."""
    labels = getattr(system, key, None)
    return None if not labels or any("[" in label for label in labels) else labels
