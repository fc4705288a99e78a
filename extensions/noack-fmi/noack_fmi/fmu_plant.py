"""A Functional Mock-up Unit: another tool's model, run by FMPy (FMI 2 and 3, co-simulation).

As the standard requires, its start values are set and it is initialised at t = 0. At each step of
the plant, its inputs are set, one ``doStep`` is made, and its variables are read. The FMU is native
code and runs in this process, unpacked in a folder of this user only. Its printed output is
discarded; the last error in its log is kept.
"""

import contextlib
import ctypes
import difflib
import fcntl
import io
import os
import shutil
import tempfile
import weakref
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, NoReturn

import numpy as np
from pydantic import Field, FiniteFloat

from noack.extend import (
    CallerError,
    FileSettings,
    NamedFile,
    Names,
    PlantOutline,
    PlantSettings,
    PlantStart,
    PlantSystem,
    Row,
    SystemFailedError,
    Table,
    Vector,
    checked_path,
    one_line,
    require_length,
    shortened,
)

if TYPE_CHECKING:  # slow to import
    from fmpy.fmi1 import _FMU
    from fmpy.model_description import ModelDescription, ScalarVariable

_WARNING, _DISCARD, _ERROR, _FATAL = 1, 2, 3, 4
"""Status codes of FMI."""
_REAL = {"Real", "Float64", "Float32"}
_VALUES: Mapping[str, tuple[tuple[type, ...], str]] = {
    **dict.fromkeys(_REAL, ((int, float), "a number")),
    "Boolean": ((bool,), "true or false"),
    "String": ((str,), "a text"),
}
"""Python types of a variable's value, by its FMI type; all others are whole numbers."""
_TOLERANCE = 1e-6
"""Largest relative difference between x(0) of the scenario and x(0) of the FMU."""
_LONGEST = 300
"""Largest length of a quoted text, in characters."""
_PREFIX = "noack-native-"
_STREAMS = (1, 2)
Refusal = Callable[["ScalarVariable"], str | None]
"""Returns why a variable is unsuitable; None if it is suitable."""


class FmuSettings(FileSettings, PlantSettings):
    """A Functional Mock-up Unit for co-simulation, FMI 2 or 3: a model from another tool.

    It is native code that runs in the plant's process.
    """

    has_operating_point: ClassVar = True

    kind: Literal["fmu"]
    file: str
    """The FMU; a relative name is relative to the scenario file."""
    state_variables: Annotated[Names, Field(min_length=1)]
    """The FMU's variables that make up x: real outputs or locals."""
    input_variables: Annotated[Names, Field(min_length=1)]
    """The FMU's real inputs that make up u."""
    initial_variables: Names | None = None
    """The FMU's variables that are set to x(0), in x's order; by default the state variables. With
    an empty list, the FMU starts from its own initial state, which must equal
    plant.initial_state."""
    operating_state: Row | None = None
    """Values of the state variables at x = 0; by default 0."""
    operating_input: Row | None = None
    """Values of the inputs at u = 0; by default 0."""
    parameters: dict[str, bool | int | FiniteFloat | str] = Field({})
    """Start values of further variables of the FMU."""
    on_record: Names = ()
    """Further variables of the FMU that are recorded, as z."""

    @classmethod
    def named_by(cls, label: str) -> Table | None:
        if not label.endswith(".fmu"):
            return None
        return {"kind": "fmu", "file": label, **variables_of(Path(label))}

    def outline(self) -> PlantOutline:
        states, inputs = self.state_variables, self.input_variables
        return PlantOutline(len(states), len(inputs), states, inputs)

    @property
    def internal_names(self) -> tuple[str, ...]:
        return self.on_record

    def check(self, n: int, m: int) -> None:
        """Require one variable for each of n states and m inputs.

        Raises:
            ValueError: the numbers differ.
        """
        dimensions = f"the model has {n} states and {m} inputs"
        require_length(self.state_variables, "plant.system.state_variables", n, dimensions)
        require_length(self.input_variables, "plant.system.input_variables", m, dimensions)
        require_length(self.initial_variables or None, "plant.system.initial_variables", n, dimensions)
        require_length(self.operating_state, "plant.system.operating_state", n, dimensions)
        require_length(self.operating_input, "plant.system.operating_input", m, dimensions)

    def system(self, start: PlantStart) -> PlantSystem:
        return FmuSystem(self, start.x0)


class FmuSystem:
    """An instance of an FMU, initialised at x(0).

    Raises:
        CallerError: FMPy is missing, the FMU does not match the settings, or it cannot be started.
    """

    def __init__(self, settings: FmuSettings, x0: Vector) -> None:
        path = checked_path(settings, "plant.system")
        self._place = f'plant.system.file = "{path.name}"'
        self._operating_state = np.array(settings.operating_state or np.zeros_like(x0))
        m = len(settings.input_variables)
        self._operating_input = np.array(settings.operating_input or np.zeros(m))
        self._log = _Log()
        end = ExitStack()
        _unpacked_fmus()  # their folders are removed after this instance has ended
        weakref.finalize(self, end.close)  # when the object is deleted, or the process ends
        try:
            description = _described(path)
            self.about = _description_text(description)
            self._instance = self._load(_unpacked(path, settings, description, end), end, description)
            self._start(settings, x0, description)
        except CallerError:
            end.close()
            raise
        except Exception as error:  # FMPy has no exception class of its own for most errors
            end.close()
            self._wrong(f"cannot be started: {self._log.why(error)}")

    def advance(self, u: Vector, t_ns: int, dt_ns: int) -> None:
        """Set the inputs, make one communication step, read the variables."""
        try:
            with quiet():
                self._inputs.set(u + self._operating_input)
                status = self._instance.fmu.doStep(t_ns * 1e-9, dt_ns * 1e-9)
                if status is not None and status[1]:
                    raise RuntimeError("it requests the end of the simulation")
                self._read()
        except Exception as error:  # as above
            self._instance.status = getattr(error, "status", _ERROR)
            raise SystemFailedError(f"{self._place}: {self._log.why(error)}") from None

    def _read(self) -> None:
        self.x = self._states.get() - self._operating_state
        self.z = self._recorded.get()

    def _wrong(self, message: str) -> NoReturn:
        raise CallerError(f"{self._place}: {message}")

    def _load(self, folder: Path, end: ExitStack, description: "ModelDescription") -> "_Instance":
        fmpy = _fmpy()
        self._require_binary(folder, description)
        working_folder = Path.cwd()
        try:
            with quiet(), contextlib.redirect_stdout(io.StringIO()):
                fmu = fmpy.instantiate_fmu(
                    str(folder), description, fmi_type="CoSimulation", logger=self._log.take
                )
        finally:
            os.chdir(working_folder)  # if loading fails, FMPy does not change back
        instance = _Instance(fmu)
        end.callback(instance.release)
        return instance

    def _require_binary(self, folder: Path, description: "ModelDescription") -> None:
        fmpy = _fmpy()
        modern = description.fmiVersion.startswith("3.")
        platform = fmpy.platform_tuple if modern else fmpy.platform
        name = description.coSimulation.modelIdentifier + fmpy.sharedLibraryExtension
        if (folder / "binaries" / platform / name).is_file():
            return
        platforms = sorted(entry.name for entry in (folder / "binaries").glob("*") if entry.is_dir())
        content = f"binaries for {', '.join(platforms)} only" if platforms else "no binaries"
        sources = (folder / "sources").is_dir()
        hint = "; it has sources, which `fmpy compile` can compile" if sources else ""
        self._wrong(f"has {content}; this machine needs {platform}/{name}{hint}")

    def _start(self, settings: FmuSettings, x0: Vector, description: "ModelDescription") -> None:
        fmu, variables = self._instance.fmu, _Variables(description)

        def port(key: str, names: Sequence[str], refusal: Refusal = lambda variable: None) -> _Port:
            return _Port(fmu, variables.real(key, names, refusal))

        self._states = port("state_variables", settings.state_variables, _not_readable)
        self._inputs = port("input_variables", settings.input_variables, _not_an_input)
        self._recorded = port("on_record", settings.on_record)
        initial = settings.initial_variables
        if initial is None:
            initial = settings.state_variables
        start = port("initial_variables", initial, _not_initial)
        parameters = [variables.parameter(*entry) for entry in settings.parameters.items()]
        with quiet():
            if description.fmiVersion == "2.0":
                fmu.setupExperiment(startTime=0.0)
            for variable, value in parameters:
                _set(fmu, variable.type, [variable.valueReference], [value])
            if initial:
                start.set(x0 + self._operating_state)
            fmu.enterInitializationMode()
            self._inputs.set(self._operating_input)
            fmu.exitInitializationMode()
            self._instance.started = True
            self._read()
        self._require_start(x0)

    def _require_start(self, x0: Vector) -> None:
        """Raise CallerError if the FMU begins at another state."""
        scale = np.abs(x0) + np.abs(self._operating_state) + 1.0
        if not np.all(np.abs(self.x - x0) <= _TOLERANCE * scale):
            raise CallerError(
                f"plant.initial_state: it is {x0.tolist()}, but the FMU begins at "
                f"{self.x.tolist()}; name in plant.system.initial_variables the variables to set"
            )


class _UnpackedFmus:
    """Folders of unpacked FMUs that no instance uses, by path and SHA-256.

    Two instances at the same time have a folder each, and so a library each. The next instance takes
    the folder of one that has ended: a linearisation makes hundreds of them. The folders are removed
    when this process ends.
    """

    def __init__(self) -> None:
        self._idle: dict[tuple[Path, str | None], list[Path]] = defaultdict(list)
        self._end = ExitStack()
        weakref.finalize(self, self._end.close)

    def take(self, path: Path, sha256: str | None, end: ExitStack) -> Path:
        """Return a folder with the content of an FMU, until ``end`` gives it back."""
        idle = self._idle[path, sha256]
        if not idle:
            folder = self._end.enter_context(temporary_folder())
            _fmpy().extract(str(path), str(folder))
            idle.append(folder)
        folder = idle.pop()
        end.callback(idle.append, folder)
        return folder


_unpacked_fmus = cache(_UnpackedFmus)
"""Returns those of this process."""


def _unpacked(path: Path, settings: FmuSettings, description: "ModelDescription", end: ExitStack) -> Path:
    """Return a folder with the content of an FMU."""
    if not description.coSimulation.canBeInstantiatedOnlyOncePerProcess:
        return _unpacked_fmus().take(path, settings.sha256, end)
    folder = end.enter_context(temporary_folder())
    _fmpy().extract(str(path), str(folder))
    return folder


def variables_of(path: Path) -> dict[str, list[str]]:
    """Return the keys state_variables and input_variables for an FMU.

    The states are the variables whose derivatives the FMU names; if it names none, its outputs.
    """
    real = [variable for variable in _described(path).modelVariables if _not_a_real_scalar(variable) is None]
    states = [variable.derivative.name for variable in real if variable.derivative is not None]
    outputs = [variable.name for variable in real if variable.causality == "output"]
    inputs = [variable.name for variable in real if variable.causality == "input"]
    return {"state_variables": states or outputs, "input_variables": inputs}


def _described(path: Path) -> "ModelDescription":
    """Return an FMU's description; raise CallerError unless it is for co-simulation, FMI 2 or 3."""
    file = NamedFile(path.name, path.parent, "plant.system")
    file.sha256()  # it can be read
    fmpy = _fmpy()
    try:
        with path.open("rb") as content:  # FMPy does not close a file that it cannot read
            description = fmpy.read_model_description(content, validate=False)
    except Exception as error:  # a file that is not an FMU can raise any error
        file.wrong(f"is not an FMU of FMI 2 or 3, or is damaged: {_short_line(error)}")
    if description.fmiVersion.startswith("1."):
        file.wrong(f"is of FMI {description.fmiVersion}; FMI 2 and 3 are supported")
    if description.coSimulation is None:
        file.wrong("is not for co-simulation; export it as a co-simulation FMU")
    return description


class _Instance:
    """An instance of an FMU, and its state by the standard."""

    def __init__(self, fmu: "_FMU") -> None:
        self.fmu = fmu
        self.started = False
        self.status = 0

    def release(self) -> None:
        """Terminate and free the instance, as far as its status permits."""
        if self.status >= _FATAL:
            return
        with quiet():
            if self.started and self.status <= _WARNING:
                with contextlib.suppress(Exception):
                    self.fmu.terminate()
            with contextlib.suppress(Exception):
                self.fmu.freeInstance()


class _Log:
    """The last message of an FMU that is more severe than a warning."""

    def __init__(self) -> None:
        self._last = ""

    def take(self, *arguments: object) -> None:
        """Keep a message; FMI 2: (environment, name, status, category, message), FMI 3: no name."""
        *_, status, _, message = arguments
        assert isinstance(status, int)
        if status > _WARNING and isinstance(message, bytes):
            self._last = _short_line(message.decode(errors="replace"))

    def why(self, error: Exception) -> str:
        """Return an error's text, with the FMU's last message."""
        return f"{_short_line(error)} ({self._last})" if self._last else _short_line(error)


class _Variables:
    """The variables of an FMU, with checks of their properties.

    If a variable is missing or unsuitable, every method raises a CallerError of one line.
    """

    def __init__(self, description: "ModelDescription") -> None:
        self._known: Mapping[str, ScalarVariable] = {
            variable.name: variable for variable in description.modelVariables
        }

    def real(self, key: str, names: Sequence[str], refusal: Refusal) -> list["ScalarVariable"]:
        """Return real scalars that are not refused."""
        variables = [self._variable(key, name) for name in names]
        twice = next((name for name, count in Counter(names).items() if count > 1), None)
        if twice is not None:
            raise CallerError(f'plant.system.{key}: "{twice}" is named twice')
        for variable in variables:
            if reason := _not_a_real_scalar(variable) or refusal(variable):
                _refuse(key, variable, reason)
        return variables

    def parameter(self, name: str, value: object) -> tuple["ScalarVariable", object]:
        """Return a variable and its start value."""
        variable = self._variable("parameters", name)
        kinds, expected = _VALUES.get(variable.type, ((int,), "a whole number"))
        if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
            _refuse("parameters", variable, f"is of type {variable.type}; give {expected}, not {value!r}")
        if variable.causality == "input":
            _refuse("parameters", variable, "is an input; its value at rest is operating_input")
        if reason := _not_settable(variable):
            _refuse("parameters", variable, reason)
        return variable, value

    def _variable(self, key: str, name: str) -> "ScalarVariable":
        if name in self._known:
            return self._known[name]
        close = difflib.get_close_matches(name, self._known, n=1)
        examples = ", ".join(list(self._known)[:8])
        hint = f"did you mean {close[0]}?" if close else f"it has {examples}"
        raise CallerError(f'plant.system.{key}: the FMU has no variable "{name}"; {hint}')


def _refuse(key: str, variable: "ScalarVariable", reason: str) -> NoReturn:
    raise CallerError(f'plant.system.{key}: the FMU\'s "{variable.name}" {reason}')


class _Port:
    """Real variables of an instance, read or set together."""

    def __init__(self, fmu: "_FMU", variables: Sequence["ScalarVariable"]) -> None:
        self._fmu, self._size = fmu, len(variables)
        places: dict[str, tuple[list[int], list[int]]] = {}
        for index, variable in enumerate(variables):
            indices, references = places.setdefault(variable.type, ([], []))
            indices.append(index)
            references.append(variable.valueReference)
        self._places = [(kind, indices, references) for kind, (indices, references) in places.items()]

    def get(self) -> Vector:
        """Return the variables' values."""
        values = np.empty(self._size)
        for kind, indices, references in self._places:
            values[indices] = getattr(self._fmu, f"get{kind}")(references)
        return values

    def set(self, values: Vector) -> None:
        """Set the variables to values."""
        for kind, indices, references in self._places:
            _set(self._fmu, kind, references, values[indices].tolist())


def _set(fmu: "_FMU", kind: str, references: Sequence[int], values: Sequence[object]) -> None:
    if kind == "Enumeration":
        kind = "Int64" if hasattr(fmu, "setInt64") else "Integer"
    getattr(fmu, f"set{kind}")(references, values)


def _not_a_real_scalar(variable: "ScalarVariable") -> str | None:
    if variable.type not in _REAL:
        return f"is of type {variable.type}; real numbers are needed"
    return "is an array; name scalar variables" if variable.dimensions else None


def _not_readable(variable: "ScalarVariable") -> str | None:
    readable = variable.causality in ("output", "local")
    return None if readable else f"is neither output nor local, but {variable.causality}"


def _not_an_input(variable: "ScalarVariable") -> str | None:
    return None if variable.causality == "input" else f"is no input, but {variable.causality}"


def _not_settable(variable: "ScalarVariable") -> str | None:
    """Refuse a variable that cannot be set before the initialisation."""
    from fmpy.simulation import settable_in_instantiated

    if settable_in_instantiated(variable):
        return None
    return "cannot be set at the start"


def _not_initial(variable: "ScalarVariable") -> str | None:
    """Refuse a variable to which x(0) cannot be written."""
    reason = _not_settable(variable)
    return reason and f"{reason}; name variables whose initial is exact or approx, or none: []"


def _description_text(description: "ModelDescription") -> str:
    tool = description.generationTool or "a tool that it does not name"
    needs = "; it needs that tool to run" if description.coSimulation.needsExecutionTool else ""
    return f"FMU {description.modelName}, FMI {description.fmiVersion}, by {tool}{needs}"


def _fmpy() -> ModuleType:
    with contextlib.redirect_stdout(io.StringIO()):  # the import prints warnings about the platform
        return import_module("fmpy")


def _short_line(message: BaseException | str) -> str:
    return shortened(one_line(message), _LONGEST)


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """Create a folder for this user only and remove it at the end; remove abandoned folders first.

    A lock marks a folder that is in use. The lock ends with its process, even if that process is
    killed; a folder without a lock is abandoned.
    """
    for abandoned in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        _remove_if_left(abandoned)
    while True:
        folder = Path(tempfile.mkdtemp(prefix=_PREFIX))
        descriptor = _locked(folder)
        if descriptor is not None and folder.is_dir():
            break
        if descriptor is not None:  # another process removed it before it was locked
            os.close(descriptor)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(descriptor)


def _remove_if_left(folder: Path) -> None:
    with suppress(OSError):
        if folder.lstat().st_uid != os.getuid():
            return
        descriptor = _locked(folder)
        if descriptor is not None:
            shutil.rmtree(folder, ignore_errors=True)
            os.close(descriptor)


def _locked(folder: Path) -> int | None:
    """Lock a folder; return its descriptor, None if another holds a lock or there is no folder."""
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except OSError:
        return None
    with suppress(OSError):
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return descriptor
    os.close(descriptor)
    return None


@contextmanager
def quiet() -> Iterator[None]:
    """Discard all output that native code prints in this context; it may print at every step."""
    copies = []
    with suppress(OSError):  # a stream that is closed stays closed
        for stream in _STREAMS:
            copies.append((stream, os.dup(stream)))  # noqa: PERF401
    null = os.open(os.devnull, os.O_WRONLY)
    for stream, _ in copies:
        os.dup2(null, stream)
    os.close(null)
    try:
        yield
    finally:
        ctypes.CDLL(None).fflush(None)  # otherwise its buffer is printed later
        for stream, copy in copies:
            os.dup2(copy, stream)
            os.close(copy)
